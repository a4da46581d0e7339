"""Cases, kept in a file that a first process writes (they take some seconds)."""

import os, pickle


def cases():
    path = os.environ.get("CASES_FILE", "/tmp/totals_cases.pkl")
    try:
        with open(path, "rb") as f:
            return pickle.load(f)
    except Exception:
        from benchmarks.tactile.scene import totals_cases

        every = list(totals_cases(200).items())
        try:
            with open(f"{path}.{os.getpid()}", "wb") as f:
                pickle.dump(every, f)
            os.replace(f"{path}.{os.getpid()}", path)
        except Exception as e:
            print("no file of cases:", e)
        return every


if __name__ == "__main__":
    cases()
