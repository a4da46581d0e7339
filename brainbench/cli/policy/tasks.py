"""``brainbench policy tasks``: what there is to do."""

from __future__ import annotations

from brainbench.cli.output import JsonOption, emit, table


def list_tasks(as_json: JsonOption = False) -> None:
    """List the tasks with their success, length, observation groups, and the policies that come with the package."""
    from robotics_bridge import tasks
    from robotics_bridge.policies.shipped import list_students, list_teachers

    found = []
    for name in tasks.list_tasks():
        task = tasks.load(name)
        student = [*task.groups["student"], "tactile"]
        found.append(
            {
                "task": name,
                "text": task.text,
                "seconds": task.episode,
                "metric": task.success.metric,
                "success_from": task.success.threshold,
                "student": student,
                "teacher": list(task.groups["actor"]),
                "shipped": [*list_teachers(name), *list_students(name)],
            }
        )
    rows = [
        [
            f["task"], f["text"], f"{f['seconds']:g}", f"{f['metric']} ≥ {f['success_from']:.3g}",
            ", ".join(f["student"]), ", ".join(f["shipped"]),
        ]
        for f in found
    ]  # fmt: skip
    emit(found, table("", ["task", "what to do", "s", "success", "student sees", "trained"], rows), as_json=as_json)
