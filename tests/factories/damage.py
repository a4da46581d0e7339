"""Seeded damage to files: bytes, the texts of JSON, TOML and CSV, HDF5 trees, safetensors, and what is no file."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
from pathlib import Path

import h5py
import numpy as np

TOKENS = (
    "NaN", "nan", "Infinity", "inf", "-inf", "1e400", "-1", "0", "1e300", "1e-300", "-0.5", "2.5", "9" * 5000,
    "99999999999999999999", "2147483648", "true", "null", '"x"', "[]", "{}", "[[]]", '"\\u0000"', "'" * 3,
)  # fmt: skip
"""What takes the place of a value in a text."""
_VALUE = re.compile(rb'"[^"\n]*"|-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?|true|false|null')
_NUMBERS = (np.nan, np.inf, -np.inf, -1.0, 1e300, 0.0, 3.5)


def damage(path: Path, seed: int) -> str:
    """Damage a file in place and say how; equal seeds do the same."""
    chance = random.Random(seed)
    special = (_folder, _pipe, _endless, _dangling, _loop, _empty)
    # The first seeds try each thing that is no file once; the others draw.
    if seed < len(special):
        return special[seed](path)
    kinds = [_bytes]
    if path.suffix in (".h5", ".nwb"):
        kinds += [_hdf5] * 4
    elif path.suffix == ".safetensors":
        kinds += [_tensors] * 3
    elif path.suffix in (".json", ".toml", ".csv", ".txt", ".obj", ".off"):
        kinds += [_text] * 4
    return chance.choice(kinds)(path, chance)


def _folder(path: Path) -> str:
    path.unlink()
    path.mkdir()
    return "a folder"


def _pipe(path: Path) -> str:
    path.unlink()
    os.mkfifo(path)
    return "a FIFO"


def _endless(path: Path) -> str:
    path.unlink()
    path.symlink_to("/dev/zero")
    return "a device without end"


def _dangling(path: Path) -> str:
    path.unlink()
    path.symlink_to(path.with_name("gone"))
    return "a link to nothing"


def _loop(path: Path) -> str:
    path.unlink()
    path.symlink_to(path)
    return "a link to itself"


def _empty(path: Path) -> str:
    path.write_bytes(b"")
    return "empty"


def _bytes(path: Path, chance: random.Random) -> str:
    data = bytearray(path.read_bytes())
    kind = chance.choice(("flip", "truncate", "zero", "repeat", "append", "noise"))
    place = chance.randrange(max(1, len(data)))
    if kind == "flip":
        for _ in range(chance.choice((1, 4, 32))):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif kind == "truncate":
        del data[place:]
    elif kind == "zero":
        end = min(len(data), place + chance.choice((8, 64, 1024)))
        data[place:end] = bytes(end - place)
    elif kind == "repeat":
        data[place:place] = data[place : place + 512]
    elif kind == "append":
        data += chance.randbytes(512)
    else:
        end = min(len(data), place + chance.choice((4, 16)))
        data[place:end] = b"\xff" * (end - place)
    path.write_bytes(data)
    return kind


def _text(path: Path, chance: random.Random) -> str:
    data = path.read_bytes()
    if chance.random() < 0.1:
        deep = {".toml": b"x = " + b"[" * 50_000, ".json": b'{"a":' * 50_000}.get(path.suffix, b"[" * 50_000)
        path.write_bytes(deep)
        return "deep nesting"
    values = list(_VALUE.finditer(data))
    if not values:
        return _bytes(path, chance)
    for _ in range(chance.choice((1, 1, 2))):
        found, token = chance.choice(values), chance.choice(TOKENS)
        after = data[found.end() : found.end() + 1]
        # A key of JSON stays a key: its value is what shall change.
        if after == b":" and token[0] != '"':
            token = json.dumps(token[:80])
        if path.suffix in (".csv", ".obj", ".off", ".txt"):
            token = token.strip('"')
        data = data[: found.start()] + token.encode() + data[found.end() :]
        values = list(_VALUE.finditer(data))
    path.write_bytes(data)
    return f"{token[:12]} for {found.group()[:12]!r}"


def _hdf5(path: Path, chance: random.Random) -> str:
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = chance.choice(names)
        item = file[name]
        places = [key for key in (name, *names, "/") if file[key].attrs]
        if places and chance.random() < 0.25:
            attributes = file[chance.choice(places)].attrs
            return _attribute(attributes, chance.choice(list(attributes)), chance)
        kinds = ["delete", "group", "dangling", "external"]
        if isinstance(item, h5py.Dataset):
            kinds += ["number"] * 5 + ["type", "shape", "huge", "null", "reference"]
        kind = chance.choice(kinds)
        if kind == "number":
            if item.dtype.kind not in "fiu" or not item.size:
                kind = "type"
            else:
                values = np.asarray(item[()])
                number = chance.choice(_NUMBERS)
                if item.dtype.kind in "iu":
                    number = chance.choice((0, 1, 127, -1 if item.dtype.kind == "i" else 200))
                flat = values.reshape(-1)
                with np.errstate(over="ignore"):
                    flat[chance.randrange(flat.size)] = number
                item[()] = flat.reshape(values.shape)
                return f"{number} in {name}"
        old = np.asarray(item[()]) if isinstance(item, h5py.Dataset) else np.zeros(2)
        del file[name]
        if kind == "group":
            file.create_group(name)
        elif kind == "dangling":
            file[name] = h5py.SoftLink("/nowhere")
        elif kind == "external":
            file[name] = h5py.ExternalLink("/dev/zero", "/x")
        elif kind == "type":
            file[name] = chance.choice(
                [np.array([b"x"] * 3), np.full(old.shape, True), np.full(old.shape, 1 + 2j), np.zeros(old.shape, "i1"),
                 np.zeros(old.shape, [("a", "f4"), ("b", "S3")]), b"text"]
            )  # fmt: skip
        elif kind == "shape":
            file[name] = chance.choice([old[None], old.reshape(-1)[:-1], old.reshape(-1)[:1], np.zeros((0, 3))])
        elif kind == "huge":
            shape = tuple(2**20 for _ in range(max(1, old.ndim)))
            file.create_dataset(name, shape=shape if old.ndim > 1 else (2**36,), dtype="f8", chunks=True)
        elif kind == "null":
            file[name] = h5py.Empty("f8")
        elif kind == "reference":
            file.create_dataset(name, data=np.array([file.ref] * 2, dtype=object), dtype=h5py.ref_dtype)
        return f"{kind} {name}"


def _attribute(attributes: h5py.AttributeManager, name: str, chance: random.Random) -> str:
    kind = chance.choice(("delete", "number", "array", "text", "empty"))
    del attributes[name]
    if kind != "delete":
        choices = {"number": np.nan, "array": np.arange(4.0), "text": "[" * 2000, "empty": h5py.Empty("f4")}
        attributes[name] = choices[kind]
    return f"attribute {name}: {kind}"


def _tensors(path: Path, chance: random.Random) -> str:
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
    name = chance.choice([key for key in header if key != "__metadata__"])
    kind = chance.choice(("nan", "inf", "shape", "dtype", "drop", "rename", "offset", "length", "deep"))
    if kind in ("nan", "inf"):
        first = header[name]["data_offsets"][0]
        body[first : first + 4] = np.float32(np.nan if kind == "nan" else np.inf).tobytes()
    elif kind == "shape":
        header[name]["shape"] = chance.choice([[2**40], [], [1], [-1], [2**62, 4]])
    elif kind == "dtype":
        header[name]["dtype"] = chance.choice(["F64", "I8", "XX", 3, None])
    elif kind == "drop":
        del header[name]
    elif kind == "rename":
        header["other"] = header.pop(name)
    elif kind == "offset":
        header[name]["data_offsets"] = chance.choice([[0, 2**50], [-4, 0], [8, 4], ["a", 1]])
    text = b"[" * 50_000 if kind == "deep" else json.dumps(header).encode()
    size = 2**40 if kind == "length" else len(text)
    path.write_bytes(size.to_bytes(8, "little") + text + body)
    return f"{kind} {name}"


def remove(path: Path) -> None:
    """Remove whatever :func:`damage` left at a path."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
