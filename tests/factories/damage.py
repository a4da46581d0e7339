"""Seeded damage to values and files: nested data, bytes, texts, HDF5 trees, archives, weights, and what is no file."""

from __future__ import annotations

import copy
import json
import math
import os
import random
import re
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch

TOKENS = (
    "NaN", "nan", "Infinity", "inf", "-inf", "1e400", "-1", "0", "1e300", "1e-300", "-0.5", "2.5", "9" * 5000,
    "99999999999999999999", "2147483648", "true", "null", '"x"', "[]", "{}", "[[]]", '"\\u0000"', "'" * 3,
)  # fmt: skip
"""What takes the place of a value in a text."""
SPECIAL = 6
"""Seeds that put what is no file in the place of one."""
_VALUE = re.compile(rb'"[^"\n]*"|-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?|true|false|null')
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")
_XML = (".xml", ".urdf")
TEXTS = (".json", ".toml", ".csv", ".txt", ".obj", ".off", ".xml", ".urdf", ".yaml", ".key")
ODD: tuple[Any, ...] = (
    math.nan, math.inf, -math.inf, 1e308, -1e308, 1e-320, 2**31, -(2**31), 2**63, -1, 0, 0.5, True, None, "", " ",
    "nan", "x" * 5000, [], {}, [[]], {"a": {}}, [None], [math.nan] * 3, "../../etc/passwd", "os:system", "\x00",
    "\u202e", "\ud800", "1", 10**400, [[0] * 3] * 1000,
)  # fmt: skip
"""What takes the place of a value."""
TWINS = str.maketrans({"a": "а", "e": "е", "o": "о", "i": "і", "x": "х", "p": "р", "c": "с"})
"""Latin letters and the Cyrillic ones that look like them."""
_NUMBERS = (np.nan, np.inf, -np.inf, -1.0, 1e300, 0.0, 3.5)


def damage(path: Path, seed: int) -> str:
    """Damage a file in place and say how; equal seeds do the same."""
    chance = random.Random(seed)
    # The first seeds try each thing that is no file once; the others draw.
    if seed < SPECIAL:
        return _replace(path, seed)
    kinds = {".h5": [_hdf5] * 4, ".nwb": [_hdf5] * 4, ".safetensors": [_tensors] * 3, ".npz": [_npz] * 4}
    kinds |= dict.fromkeys(TEXTS, [_text] * 4) | {".ckpt": [_checkpoint] * 4}
    return chance.choice([_bytes, *kinds.get(path.suffix, ())])(path, chance)


def _replace(path: Path, seed: int) -> str:
    """Put what is no file in the place of one, or empty it."""
    things: dict[str, Callable[[], Any]] = {
        "a folder": path.mkdir,
        "a FIFO": partial(os.mkfifo, path),
        "a device without end": partial(path.symlink_to, "/dev/zero"),
        "a link to nothing": partial(path.symlink_to, path.with_name("gone")),
        "a link to itself": partial(path.symlink_to, path),
        "empty": partial(path.write_bytes, b""),
    }
    name, put = list(things.items())[seed]
    if name != "empty":
        path.unlink()
    put()
    return name


def damage_bytes(whole: bytes, chance: random.Random) -> tuple[bytes, str]:
    """Return bytes of which a part is changed, cut off, repeated or overwritten, and how."""
    data = bytearray(whole)
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
    return bytes(data), kind


def damaged(data: bytes, seed: int) -> bytes:
    """Return bytes with such damage; equal seeds do the same."""
    return damage_bytes(data, random.Random(seed))[0]


def _bytes(path: Path, chance: random.Random) -> str:
    data, kind = damage_bytes(path.read_bytes(), chance)
    path.write_bytes(data)
    return kind


def _text(path: Path, chance: random.Random) -> str:
    data = path.read_bytes()
    if chance.random() < 0.1:
        deep = {".toml": b"x = " + b"[" * 50_000, ".json": b'{"a":' * 50_000, ".yaml": b"a: " + b"[" * 50_000}
        deep |= dict.fromkeys(_XML, b"<a>" * 50_000)
        path.write_bytes(deep.get(path.suffix, b"[" * 50_000))
        return "deep nesting"
    # In XML every value is quoted: the numbers within are what shall change.
    pattern = _NUMBER if path.suffix in _XML else _VALUE
    values = list(pattern.finditer(data))
    if not values:
        return _bytes(path, chance)
    for _ in range(chance.choice((1, 1, 2)) if len(values) > 1 else 1):
        found, token = chance.choice(values), chance.choice(TOKENS)
        after = data[found.end() : found.end() + 1]
        # A key of JSON stays a key: its value is what shall change.
        if after == b":" and token[0] != '"':
            token = json.dumps(token[:80])
        if path.suffix in (".csv", ".obj", ".off", ".txt", ".yaml", *_XML):
            token = token.strip('"')
        data = data[: found.start()] + token.encode() + data[found.end() :]
        values = list(pattern.finditer(data))
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


def _npz(path: Path, chance: random.Random) -> str:
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = chance.choice(list(arrays))
    values = arrays[name]
    kind = chance.choice(
        ("number", "number", "number", "drop", "rename", "shape", "type", "objects", "header", "foreign")
    )
    if kind == "number" and values.dtype.kind == "f" and values.size:
        number = chance.choice(_NUMBERS)
        values.reshape(-1)[chance.randrange(values.size)] = number
        kind = f"{number}"
    elif kind in ("drop", "rename"):
        del arrays[name]
        arrays |= {"other": values} if kind == "rename" else {}
    elif kind == "shape":
        arrays[name] = chance.choice([values[None], values.reshape(-1)[:-1], np.zeros((0, 6, 2)), np.zeros(())])
    elif kind == "objects":
        arrays[name] = np.array([{}, None], dtype=object)
    else:
        others = ([b"x"], [True] * 3, [1j], np.nan, "NaN", "9" * 5000, -1, 1e300, [np.datetime64("NaT")])
        arrays[name] = np.array(chance.choice(others))
    np.savez(path, **arrays)
    if kind in ("header", "foreign"):
        with zipfile.ZipFile(path, "a") as archive, archive.open("extra.npy", "w") as stream:
            shape = chance.choice(((2**40,), (2**62, 4), (-1,), ("a",), (3,)))
            header = {"descr": "<f8", "fortran_order": False, "shape": shape}
            stream.write(b"<a/>") if kind == "foreign" else np.lib.format.write_array_header_1_0(stream, header)
    return f"{kind} {name}"


class Unknown:
    """An object that only pickle could bring back."""


def _checkpoint(path: Path, chance: random.Random) -> str:
    content = torch.load(path, weights_only=True)
    state = content["state_dict"]
    name = chance.choice([key for key, value in state.items() if value.ndim])
    kind = chance.choice(
        ("nan", "inf", "drop", "rename", "shape", "huge", "type", "object", "epoch", "state", "deep", "sparse", "meta")
    )
    if kind in ("nan", "inf"):
        state[name] = state[name].clone()
        state[name].reshape(-1)[0] = float(kind)
    elif kind in ("drop", "rename"):
        state["other"] = state.pop(name)
        del state["other" if kind == "drop" else next(iter(state))]
    elif kind == "shape":
        state[name] = chance.choice([state[name][None], state[name][:0], torch.zeros(()), torch.zeros(3, 70)])
    elif kind == "huge":
        # A single stored number stands for as many as one likes.
        state[name] = torch.zeros(1).expand(2**40)
    elif kind == "type":
        state[name] = chance.choice(
            [state[name].to(torch.complex64), state[name].bool(), state[name].to(torch.float16) * 1e6, "x", None, 3]
        )
    elif kind == "object":
        content["hyper_parameters"] = Unknown()
    elif kind == "epoch":
        content["epoch"] = chance.choice([-1, float("nan"), "x", 2**80, None, [1]])
    elif kind == "state":
        content["state_dict"] = chance.choice([3, {}, {"a": {}}, {3: torch.zeros(1)}, [torch.zeros(2)], {"": name}])
    elif kind == "deep":
        nested: Any = name
        for _ in range(400):
            nested = [nested]
        content["state_dict"] = {**state, name: nested}
    else:
        state[name] = state[name].to_sparse() if kind == "sparse" else state[name].to("meta")
    torch.save(content, path)
    return f"{kind} {name}"


def mutate(value: Any, seed: int) -> Any:
    """Return a JSON value with one to three places changed, removed, doubled or moved."""
    chance = random.Random(seed)
    for _ in range(chance.randint(1, 3)):
        alter(value, chance)
    return value


def alter(value: Any, chance: random.Random) -> str:
    """Change one place in a nested value."""
    places = _places(value)
    if not places:
        return "nothing"
    return change(*chance.choice(places), chance)


def change(holder: Any, key: Any, chance: random.Random) -> str:
    """Change what stands at a key or index of a mapping or list."""
    kinds = ["odd"] * 5
    if isinstance(holder, dict):
        kinds += ["drop", "drop", "rename", "extra"]
    else:
        kinds += ["drop", "double", "swap"]
    if isinstance(holder[key], (int, float)) and not isinstance(holder[key], bool):
        kinds += ["scale"] * 3 + ["sign", "text"]
    if isinstance(holder[key], list) and holder[key]:
        kinds += ["empty", "nest", "repeat", "shorter"]
    if isinstance(holder[key], str):
        kinds += ["twin", "upper", "long"]
    kind, old = chance.choice(kinds), holder[key]
    if kind == "odd":
        holder[key] = copy.deepcopy(chance.choice(ODD))
    elif kind == "drop":
        del holder[key]
    elif kind == "rename":
        holder[chance.choice((key.translate(TWINS), key.upper(), f"{key} ", "__class__"))] = holder.pop(key)
    elif kind == "extra":
        holder[chance.choice(("x", "__proto__", "", "é", key + "_"))] = old
    elif kind == "double" and isinstance(holder, list):
        holder.append(old)
    elif kind == "swap":
        holder[key], holder[0] = holder[0], holder[key]
    elif kind == "scale":
        holder[key] = old * 10.0 ** chance.randint(-300, 300) if abs(old) < 1e8 else -old
    else:
        changes: dict[str, Callable[[], Any]] = {
            "sign": lambda: -old,
            "text": lambda: str(old),
            "empty": list,
            "nest": lambda: [old],
            "repeat": lambda: old * 300,
            "shorter": lambda: old[:-1],
            "twin": lambda: old.translate(TWINS),
            "upper": old.upper if kind == "upper" else str,
            "long": lambda: old * 999,
        }
        holder[key] = changes[kind]()
    return f"{kind} {str(key)[:20]}"


def _places(value: Any) -> list[tuple[Any, Any]]:
    places: list[tuple[Any, Any]] = []
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in pairs:
        places += [(value, key), *_places(inner)]
    return places
