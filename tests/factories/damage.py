"""Seeded damage to values and files: nested data, bytes, texts, HDF5 trees, archives, weights, and what is no file."""

from __future__ import annotations

import copy
import json
import math
import os
import random
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
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


def _put(holder: Any, key: str, table: Mapping[str, Sequence[Any]], chance: random.Random) -> str:
    """Put a value of a table, by its kind, in the place of an entry, or drop or rename that; functions put it there."""
    kind, old = chance.choice((*table, "drop", "rename")), holder[key]
    del holder[key]
    value = old if kind == "rename" else None if kind == "drop" else chance.choice(table[kind])
    if callable(value):
        value(holder, key)
    elif kind != "drop":
        holder["other" if kind == "rename" else key] = value
    return f"{kind} {key}"


def _spoil(values: np.ndarray, chance: random.Random) -> str:
    """Put an odd number, which its kind can hold, in the place of one of an array."""
    whole = {"i": (0, 1, 127, -1), "u": (0, 1, 127, 200)}
    number = chance.choice(whole.get(values.dtype.kind, _NUMBERS))
    with np.errstate(over="ignore"):
        values.flat[chance.randrange(values.size)] = number
    return f"{number}"


_LINKS = {
    "group": (h5py.File.create_group,),
    "dangling": (h5py.SoftLink("/nowhere"),),
    "external": (h5py.ExternalLink("/dev/zero", "/x"),),
}
_ATTRIBUTES = {"number": (np.nan,), "array": (np.arange(4.0),), "text": ("[" * 2000,), "empty": (h5py.Empty("f4"),)}


def _hdf5(path: Path, chance: random.Random) -> str:
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        name = chance.choice(names)
        places = [key for key in (name, *names, "/") if file[key].attrs]
        if places and chance.random() < 0.25:
            attributes = file[chance.choice(places)].attrs
            return f"attribute {_put(attributes, chance.choice(list(attributes)), _ATTRIBUTES, chance)}"
        item = file[name]
        if not isinstance(item, h5py.Dataset):
            return _put(file, name, _LINKS, chance)
        old = np.asarray(item[()])
        if old.dtype.kind in "fiu" and old.size and chance.random() < 0.4:
            what = _spoil(old, chance)
            item[()] = old
            return f"{what} in {name}"
        shape, empty = old.shape, np.zeros((0, 3))
        endless = {"shape": (2**20,) * old.ndim if old.ndim > 1 else (2**36,), "dtype": "f8", "chunks": True}
        references = {"data": np.array([file.ref] * 2, dtype=object), "dtype": h5py.ref_dtype}
        kinds = (np.full(shape, True), np.full(shape, 1 + 2j), np.zeros(shape, "i1"), np.zeros(shape, "f4,S3"))
        odd = {
            "type": (np.array([b"x"] * 3), *kinds, b"text"),
            "shape": (old[None], old.reshape(-1)[:-1], old.reshape(-1)[:1], empty),
            "null": (h5py.Empty("f8"),),
            "made": [partial(_dataset, **options) for options in (endless, references)],
        }
        return _put(file, name, _LINKS | odd, chance)


def _dataset(file: h5py.File, name: str, **options: Any) -> None:
    file.create_dataset(name, **options)


def _tensors(path: Path, chance: random.Random) -> str:
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
    name = chance.choice([key for key in header if key != "__metadata__"])
    fields = {
        "shape": ([2**40], [], [1], [-1], [2**62, 4]),
        "dtype": ("F64", "I8", "XX", 3, None),
        "data_offsets": ([0, 2**50], [-4, 0], [8, 4], ["a", 1]),
    }
    kind = chance.choice(("number", "number", "entry", "entry", "length", "deep", *fields))
    if kind == "number":
        first = header[name]["data_offsets"][0]
        body[first : first + 4] = np.float32(chance.choice((np.nan, np.inf))).tobytes()
    elif kind == "entry":
        kind = _put(header, name, {}, chance)
    elif kind in fields:
        header[name][kind] = chance.choice(fields[kind])
    text = b"[" * 50_000 if kind == "deep" else json.dumps(header).encode()
    size = 2**40 if kind == "length" else len(text)
    path.write_bytes(size.to_bytes(8, "little") + text + body)
    return f"{kind} {name}"


def _npz(path: Path, chance: random.Random) -> str:
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    name = chance.choice(list(arrays))
    values = arrays[name]
    odd = ([b"x"], [True] * 3, [1j], np.nan, "NaN", "9" * 5000, -1, 1e300, [np.datetime64("NaT")])
    table = {
        "shape": (values[None], values.reshape(-1)[:-1], np.zeros((0, 6, 2)), np.zeros(())),
        "type": [np.array(value) for value in odd],
        "objects": (np.array([{}, None], dtype=object),),
    }
    numeric = values.dtype.kind == "f" and values.size and chance.random() < 0.3
    what = _spoil(values, chance) if numeric else _put(arrays, name, table, chance)
    np.savez(path, **arrays)
    if chance.random() < 0.2:
        with zipfile.ZipFile(path, "a") as archive, archive.open("extra.npy", "w") as stream:
            shape = chance.choice(((2**40,), (2**62, 4), (-1,), ("a",), (3,), None))
            header = {"descr": "<f8", "fortran_order": False, "shape": shape}
            stream.write(b"<a/>") if shape is None else np.lib.format.write_array_header_1_0(stream, header)
            what += f", {shape} more"
    return what


class Unknown:
    """An object that only pickle could bring back."""


def _checkpoint(path: Path, chance: random.Random) -> str:
    content = torch.load(path, weights_only=True)
    state = content["state_dict"]
    name = chance.choice([key for key, value in state.items() if value.ndim])
    value, nested = state[name], reduce(lambda inner, _: [inner], range(400), name)
    first = torch.zeros_like(value, dtype=torch.bool)
    first.view(-1)[0] = True
    weights = {
        "not finite": [value.masked_fill(first, number) for number in (math.nan, math.inf)],
        "shape": (value[None], value[:0], torch.zeros(()), torch.zeros(3, 70)),
        # A single stored number stands for as many as one likes.
        "huge": (torch.zeros(1).expand(2**40),),
        "type": (value.to(torch.complex64), value.bool(), value.to(torch.float16) * 1e6, "x", None, 3),
        "elsewhere": (value.to_sparse(), value.to("meta")),
        "deep": (nested,),
    }
    entries = {
        "hyper_parameters": (Unknown(),),
        "epoch": (-1, math.nan, "x", 2**80, None, [1]),
        "state_dict": (3, {}, {"a": {}}, {3: torch.zeros(1)}, [torch.zeros(2)], {"": name}),
    }
    if chance.random() < 0.75:
        what = _put(state, name, weights, chance)
    else:
        what = chance.choice(list(entries))
        content[what] = chance.choice(entries[what])
    torch.save(content, path)
    return what


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
