"""Speed and loss of one training on one GPU and on several: the same batch, shared by so many processes.

    python -m benchmarks.models.data_parallel FOLDER --counts 1,2 --out $OUT/data-parallel.json

``FOLDER`` is a data set of sweeps. Every count is a run of torchrun; losses are those of the log's epochs.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from brainbench.core.runs.log import read_log
from brainbench.datasets import WhiskingDataset
from brainbench.models.training.config import TrainingConfig
from brainbench.models.training.trainer import train
from tests.factories.array_data import ArrayData

NETWORKS = ("zhuang-intersection-ln+gpt.supervised", "zhuang-intersection-ln.simclr", "zhuang-gru-small.supervised")
SWEEPS, BATCH, EPOCHS = 20_480, 1024, 4


def main() -> None:
    told = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    told.add_argument("folder", type=Path)
    told.add_argument("--counts", default="1,2")
    told.add_argument("--networks", default=",".join(NETWORKS))
    told.add_argument("--how", default="graphs", help="way to compile")
    told.add_argument("--out", type=Path, default=Path("data-parallel.json"))
    told.add_argument("--into", type=Path, help=argparse.SUPPRESS)
    args = told.parse_args()
    if args.into is not None:
        train_once(args)
        return
    rows = []
    for network in args.networks.split(","):
        for count in map(int, args.counts.split(",")):
            rows.append(measure(args, network, count))
            print(json.dumps(rows[-1]), flush=True)
            args.out.write_text(json.dumps(rows, indent=1), encoding="utf-8")


def measure(args: argparse.Namespace, network: str, count: int) -> dict[str, object]:
    """Train on so many devices; return the speed and the losses of the epochs."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count), "-m"]
        words += ["benchmarks.models.data_parallel", str(args.folder), "--networks", network, "--how", args.how]
        found = subprocess.run([*words, "--into", folder], check=False, capture_output=True, text=True)
        warnings = sorted({line for line in found.stderr.splitlines() if "NCCL" in line or "device" in line.lower()})
        if found.returncode:
            return {"network": network, "devices": count, "failed": found.stderr[-1500:]}
        epochs = read_log(folder, "epoch")
    speeds = [line["sweeps_per_second"] for line in epochs[1:]]
    return {
        "network": network,
        "devices": count,
        "sweeps_per_second": statistics.median(speeds),
        "losses": [line["loss"] for line in epochs],
        "warnings": warnings,
    }


def train_once(args: argparse.Namespace) -> None:
    """Train in this process of torchrun."""
    device = torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    torch.set_float32_matmul_precision("high")
    torch.backends.cudnn.benchmark = True
    source = WhiskingDataset(args.folder, split="train", batch_size=1024, shuffle=True, seed=0, device=device)
    parts = []
    for batch in source:
        parts.append((batch.input, batch.label))
        if len(parts) * 1024 >= SWEEPS:
            break
    sweeps, labels = torch.cat([x for x, _ in parts]), torch.cat([y for _, y in parts])
    data = ArrayData(source.classes, train=(sweeps, labels.cpu()), test=(sweeps[:64], labels[:64].cpu()))
    model, objective = args.networks.rsplit(".", 1)
    config = TrainingConfig.published(
        model, objective, epochs=EPOCHS, batch_size=BATCH, optimizer="adamw", schedule="constant", learning_rate=3e-4,
        warmup_epochs=0, decoder="linear", precision="bf16", compile=args.how, probe_epochs=0,
    )  # fmt: skip
    train(config, data, out=args.into)


if __name__ == "__main__":
    main()
