#!/usr/bin/env python3
"""Make an expert for `distill --expert DIR` from a TD-MPC checkpoint, without PyTorch.

    python data/import_expert.py model.pt --task walker-walk --out imported --collect 40

It reads official TD-MPC `.pt` files ({"model": ..., "model_target": ...} or a bare state dict) and
the same names in a `.safetensors` or an `.npz`; float64, float32, float16 and bfloat16 (not .npz).
What wrappers put before the names (`_orig_mod.`, `module.`, `agent.model.`) is taken off, and what
lies beside the weights (steps, settings, optimizers) left alone. DIR gets expert.npz and, with
--replay (arrays that you have, by this project's names or D4RL's, in an .npz or HDF5) or --collect
(episodes that the expert plays now), replay.npz. The expert must read dm_control's observation dict
in its own order. All that plays it follows the --action-repeat that the files then name: 2 here, in
TD-MPC's code for walker, humanoid, finger and dog, 8 for cartpole, 4 for all others. (Its reacher
has two links, this project's three.)

A file is data, whoever made it. A `.pt` is a zip around a pickle, and a pickle is a program:
`read_pickle` knows the opcodes and names that a state dict is made of and refuses all others, so
nothing in it can be run, imported or written. What a file declares (members, sizes, offsets,
strides) is checked against the bytes that it has. Memory stays below three times the unpacked
file (MAX_BYTES, MAX_RATIO), 12 bytes a weight (MAX_WEIGHTS) and 32 MiB.
"""
import contextlib
import io
import math
import pickletools
import re
import sys
import tempfile
import zipfile
from collections import namedtuple
from pathlib import Path

import numpy as np

sys.path[:0] = map(str, Path(__file__).resolve().parents[:2])
import fac_tdmpc_ref as fac  # noqa: E402
from fac_tdmpc_ref import need  # noqa: E402
from train_expert import ReplayBuffer  # noqa: E402

MAX_BYTES = 1 << 29  # of a file, unpacked; a checkpoint with Table 2's sizes has 13 MB
MAX_RATIO = 50  # unpacked bytes for each packed one, beyond the first MAX_PIECE
MAX_PIECE = 1 << 20  # that is read of a zip at once
MAX_MEMBERS = 4096  # of a zip
MAX_HEADER = 1 << 17  # bytes of data.pkl, or of a safetensors header; a checkpoint's has 10,000
MAX_WEIGHTS = 1 << 25
MAX_ENTRIES = 1 << 14  # of a checkpoint's dicts, all together
MAX_NAME = 200  # characters; longer ones are no weight's
MAX_RANK = 8
MAX_NOISE = 0.5  # largest deviation of the noise on collected actions
LEAST_EPISODES = 10  # distill holds out one in 10
RESAVE = "torch.load it where it was made and torch.save its state_dict() alone"
ELSEWHERE = ("only TD-MPC's official state dicts, for state input, can be imported; TD-MPC2's of "
             "many tasks is for data/multitask.py distill --teacher")


def short(text):
    """A name out of a file, fit for a message: escaped, and not long."""
    return ascii(str(text)[:60])


# ---------------------------------------------------------------------------- zip and .npz

class BoundedFile(io.FileIO):
    """A file that gives no more than MAX_PIECE at once: zipfile trusts declared sizes."""

    def read(self, size=-1):
        found = super().read(MAX_PIECE + 1 if size < 0 else min(size, MAX_PIECE + 1))
        need(len(found) <= MAX_PIECE, "the zip's table of contents is too large")
        return found


def read_zip(path):
    """{name: bytes} of a zip's members; nothing is unpacked before the limits are checked."""
    size, found = path.stat().st_size, {}
    limit = min(MAX_BYTES, MAX_PIECE + MAX_RATIO * size)
    with BoundedFile(path) as file, zipfile.ZipFile(file) as archive:
        members = archive.infolist()
        total = sum(m.file_size for m in members)
        need(len(members) <= MAX_MEMBERS and total <= limit, f"{len(members)} members that "
             f"unpack to {total} bytes; expected at most {MAX_MEMBERS} and {limit}")
        need(all(m.compress_type in (0, 8) and not m.flag_bits & 1 for m in members),
             "encrypted, or packed with something else than deflate; pack it anew")
        for m in members:
            need(m.filename not in found, f"{short(m.filename)}: two members of this name")
            found[m.filename] = unpack(archive, m)
    return found


def unpack(archive, member):
    """A member's bytes, never more than it declares; zipfile checks their CRC."""
    data = bytearray()
    with archive.open(member) as source:
        while piece := source.read(MAX_PIECE):
            data += piece
    need(len(data) == member.file_size, f"{short(member.filename)}: ends early")
    return data


NPY = re.compile(rb"\x93NUMPY\x01\x00(..)\{'descr': '([<>|](?:f[248]|b1|[iu][148]))', "
                 rb"'fortran_order': (True|False), 'shape': \((\d{1,9}(?:, \d{1,9})*),?\), \} *\n",
                 re.DOTALL)


Unread = namedtuple("Unread", "reason")  # an entry that matters only if it is asked for


def read_npz(path):
    """{name: array, or Unread} of an .npz. Headers are matched, not evaluated."""
    found = {}
    for name, data in read_zip(path).items():
        name, match = name.removesuffix(".npy"), NPY.match(data)
        if name == "header":  # in this project's own files
            continue
        if not match or match.end() != 10 + int.from_bytes(match[1], "little"):
            found[name] = Unread("no array of numbers as numpy.savez writes it")
            continue
        shape, dtype = [int(n) for n in match[4].split(b", ")], np.dtype(match[2].decode())
        if (0 < math.prod(shape) * dtype.itemsize == len(data) - match.end() and
                len(shape) <= MAX_RANK):
            found[name] = np.ndarray(shape, dtype, data, match.end(),
                                     order="F" if match[3] == b"True" else "C")
        else:
            found[name] = Unread(f"{dtype} {shape[:MAX_RANK]}, as it declares, in "
                                 f"{len(data) - match.end()} bytes")
    return found


# ------------------------------------------------------------------------------------- .pt

Global = namedtuple("Global", "name")  # what a pickle asks for; it stays a name
Storage = namedtuple("Storage", "data dtype")  # a tensor's memory: a member's bytes

# NumPy has no bfloat16: unsigned integers, which are read for nothing else, stand for it
STORAGES = {"torch DoubleStorage": "f8", "torch FloatStorage": "f4", "torch HalfStorage": "f2",
            "torch BFloat16Storage": "u2", "torch LongStorage": "i8", "torch IntStorage": "i4",
            "torch ByteStorage": "u1", "torch BoolStorage": "b1"}
OPCODES = set("""PROTO NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 BINFLOAT BINUNICODE EMPTY_DICT
MARK EMPTY_LIST APPEND APPENDS EMPTY_TUPLE TUPLE TUPLE1 TUPLE2 TUPLE3 BINPUT LONG_BINPUT BINGET
LONG1 LONG_BINGET SETITEM SETITEMS BUILD GLOBAL REDUCE BINPERSID""".split())
CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}


def read_pt(path):
    """What torch.save wrote: {name: array, or a dict of them}."""
    with open(path, "rb") as file:
        need(file.read(2) == b"PK", f"no zip: empty, older than PyTorch 1.6, or not its; {RESAVE}")
    members = read_zip(path)
    roots = [n[:-8] for n in members if re.fullmatch(r"([^/]+/)?data\.pkl", n)]
    need(len(roots) == 1, f"expected one data.pkl, found {len(roots)}; {RESAVE}")
    inside = {n.removeprefix(roots[0]): d for n, d in members.items() if n.startswith(roots[0])}
    order = {b"little": "<", b"big": ">"}.get(bytes(inside.get("byteorder", b"little")))
    need(order, "byteorder: expected little or big")
    try:
        return read_pickle(inside["data.pkl"], inside, order)
    except fac.UserError as error:
        raise fac.UserError(f"data.pkl {error}; that is not a state dict of weights alone, and "
                            f"nothing of it was run; {RESAVE}") from None
    except (ValueError, IndexError, KeyError):
        raise fac.UserError("data.pkl is damaged; copy or save the file anew") from None


def read_pickle(data, members, byteorder):
    """The dict that a state dict's pickle describes, built opcode by opcode; nothing is called.

    Values are None, bool, int, float, str, tuple, list, dict, Global, Storage, Unread, and arrays
    that are views of a member's bytes. An opcode makes one at most, so `data` bounds them all;
    types are compared before anything is done to a value, only str and int are hashed, and nothing
    recurs.
    """
    need(len(data) <= MAX_HEADER, f"has {len(data)} bytes, more than {MAX_HEADER}")
    stack, below, memo = [], [], {}  # below: the stacks beneath each MARK
    for name, argument in opcodes(io.BytesIO(data)):
        match name:
            case "PROTO":
                need(argument == 2, "has another protocol than 2")
            case "NONE" | "NEWTRUE" | "NEWFALSE" | "EMPTY_TUPLE":
                stack.append(CONSTANTS[name])
            case "BININT" | "BININT1" | "BININT2" | "LONG1" | "BINFLOAT" | "BINUNICODE":
                stack.append(argument)
            case "EMPTY_DICT":
                stack.append({})
            case "EMPTY_LIST":
                stack.append([])
            case "APPEND":
                add_items(stack[-2], [stack.pop()])
            case "APPENDS":
                items, stack = stack, below.pop()
                add_items(stack[-1], items)
            case "MARK":
                below.append(stack)
                stack = []
            case "TUPLE":
                items, stack = tuple(stack), below.pop()
                stack.append(items)
            case "TUPLE1" | "TUPLE2" | "TUPLE3":
                start = len(stack) - int(name[-1])
                need(start >= 0, "takes what isn't there")
                stack[start:] = [tuple(stack[start:])]
            case "BINPUT" | "LONG_BINPUT":
                memo[argument] = stack[-1]
            case "BINGET" | "LONG_BINGET":
                stack.append(memo[argument])
            case "SETITEM":
                set_items(stack[-3], [stack.pop(-2), stack.pop()])
            case "SETITEMS":
                items, stack = stack, below.pop()
                set_items(stack[-1], items)
            case "BUILD":  # the `_metadata` of a state dict, which nobody needs
                need([type(x) for x in stack[-2:]] == [dict, dict], "sets a state")
                stack.pop()
            case "GLOBAL":
                need(argument in STORAGES or argument in FUNCTIONS, f"asks for {short(argument)}")
                stack.append(Global(argument))
            case "REDUCE":
                stack.append(reduce(stack.pop(-2), stack.pop()))
            case "BINPERSID":
                stack.append(find_storage(stack.pop(), members, byteorder))
    need(not below and [type(x) for x in stack] == [dict], "holds something else than a dict")
    return stack[0]


def opcodes(stream):
    """(name, argument) of a pickle's opcodes up to STOP; others than OPCODES aren't even read."""
    while code := stream.read(1):
        opcode = pickletools.code2op.get(code.decode("latin-1"))
        name = opcode.name if opcode else repr(code)
        if name == "STOP":
            return
        need(name in OPCODES, f"has the opcode {name}")
        if name == "GLOBAL":  # the reader would interpret escapes
            yield name, " ".join(stream.readline(99).decode().rstrip("\n") for _ in range(2))
        else:
            yield name, opcode.arg.reader(stream) if opcode.arg else None
    need(False, "ends early")


def set_items(target, items):
    """A dict's next names, or numbers as an optimizer's, and values."""
    need(type(target) is dict and not len(items) % 2 and
         all(type(k) in (str, int) for k in items[::2]), "sets other items than a dict's, by names")
    target.update(zip(items[::2], items[1::2]))


def add_items(target, items):
    """A list's next values."""
    need(type(target) is list, "adds to something else than a list")
    target.extend(items)


def reduce(function, arguments):
    """What an allowed name stands for, of arguments that are checked there."""
    need(type(function) is Global and type(arguments) is tuple and function.name in FUNCTIONS and
         len(arguments) in FUNCTIONS[function.name][1:], "calls something")
    return FUNCTIONS[function.name][0](*arguments)


def find_storage(found, members, byteorder):
    """A persistent id: ("storage", type, key, device, number of elements)."""
    need(type(found) is tuple and [type(x) for x in found[:6]] == [str, Global, str, str, int] and
         found[0] == "storage", "refers to something")
    _, kind, key, _, count = found
    data, dtype = members[f"data/{key}"], np.dtype(byteorder + STORAGES[kind.name])
    need(count * dtype.itemsize == len(data), f"declares {count} elements of {dtype.itemsize} "
         f"bytes for storage {short(key)}, which has {len(data)} bytes")
    return Storage(data, dtype)


def rebuild_tensor(storage, offset, size, stride, _grad, _hooks, metadata=None):
    """A view of a storage that stays inside it."""
    need(type(storage) is Storage and type(size) is tuple and type(stride) is tuple and
         len(size) == len(stride) <= MAX_RANK and metadata is None and
         all(type(n) is int and n >= 0 for n in (offset, *size, *stride)), "has an odd tensor")
    width = storage.dtype.itemsize
    last = offset + sum((n - 1) * step for n, step in zip(size, stride))
    need(0 < math.prod(size) <= MAX_WEIGHTS and (last + 1) * width <= len(storage.data),
         "has a tensor that is empty, too large, or reaches out of its storage")
    return np.ndarray(size, storage.dtype, storage.data, offset * width,
                      [step * width * (n > 1) for n, step in zip(size, stride)])


FUNCTIONS = {"collections OrderedDict": (dict, 0),  # and how many arguments they take
             "torch._utils _rebuild_tensor_v2": (rebuild_tensor, 6, 7),
             "torch._utils _rebuild_parameter": (lambda tensor, _grad, _hooks: tensor, 3),
             # what tensordict, and TD-MPC2 with it, leaves beside weights
             "torch._utils _rebuild_meta_tensor_no_storage": (lambda *_: Unread("no values"), 4),
             "torch float32": (None,), "torch Size": (lambda size: size, 1),
             "torch device": (lambda *where: where, 1, 2)}


# ---------------------------------------------------------------------------- .safetensors

def read_safetensors(path):
    """{name: array} of a .safetensors file, by way of that library."""
    with fac.optional("safetensors", "safetensors"):
        from safetensors import deserialize
    need(path.stat().st_size <= MAX_BYTES, f"expected at most {MAX_BYTES} bytes")
    data = path.read_bytes()
    need(int.from_bytes(data[:8], "little") <= MAX_HEADER,
         f"not a safetensors file, or one with a header of more than {MAX_HEADER} bytes")
    kinds = {"F64": "<f8", "F32": "<f4", "F16": "<f2", "BF16": "<u2"}
    return {name: np.ndarray(t["shape"], kinds[t["dtype"]], t["data"])
            if t["dtype"] in kinds and len(t["shape"]) <= MAX_RANK and t["data"] else
            Unread(f"{t['dtype']} {t['shape'][:MAX_RANK]}") for name, t in deserialize(data)}


# ------------------------------------------------------------------------------------ HDF5

OWN = {"observation": "observations", "action": "actions", "continues": None}  # and D4RL's name
D4RL_ENDS = "terminals", "timeouts", "terminations", "truncations"  # the last two: Gymnasium's


def read_hdf5(path):
    """{name: array} of what a replay needs of an HDF5 file, by way of h5py: of its root, or joined
    from Minari's episodes, its groups. Of the file's own bytes alone: it may name others."""
    with fac.optional("h5py for HDF5", "hdf5"):
        import h5py
    left = limit = min(MAX_BYTES, MAX_PIECE + MAX_RATIO * path.stat().st_size)
    theirs = [*filter(None, OWN.values())]

    def own(group, name):
        need(type(group.get(name, getlink=True)) is h5py.HardLink, f"{name}: expected in this "
             "file, found a link; what is elsewhere isn't read: copy all into one file")
        return group[name]

    def arrays(group, names):
        nonlocal left
        found, at = {}, group.name.strip("/")
        for name in filter(names.__contains__, group):  # also links that lead nowhere
            data, where = own(group, name), f"{at}: {name}".removeprefix(": ")
            need(type(data) is h5py.Dataset, f"{where}: expected an array, found a group of "
                 f"{', '.join(map(short, getattr(data, 'keys', list)()))[:99]}")
            need(not (data.external or data.is_virtual) and data.dtype.kind in "fbiu", f"{where}: "
                 f"expected numbers in this file, found {short(data.dtype)}, or what others hold")
            about = data.id.get_create_plist()
            for code, *_ in map(about.get_filter, range(about.get_nfilters())):
                need(h5py.h5z.filter_avail(code), f"{where}: packed by HDF5's filter {code}, which "
                     "h5py lacks; write it with gzip, where you have that one (hdf5plugin)")
            need(data.nbytes <= left, f"{where}: with what is before it, more than {limit} bytes, "
                 "the most that is read of this file; give a part of it")
            found[name], left = data[()], left - data.nbytes
        return found

    with h5py.File(path, "r") as file:
        if episodes := [name for name in file if re.fullmatch("episode_[0-9]+", name)]:
            count = file.attrs.get("total_episodes", len(episodes))
            need(count == len(episodes), f"expected {count} episodes, its total_episodes, found "
                 f"{len(episodes)}; copy all into one file")
            return from_minari({name: arrays(own(file, name), theirs) for name in sorted(
                episodes, key=lambda name: int(name[8:]))})
        found = arrays(file, (*OWN, *theirs, *D4RL_ENDS))
        need(found, "expected observation, action and continues (README), D4RL's names, or "
             f"Minari's groups, found {', '.join(map(short, [*file][:9])) or 'nothing'}")
        return found


def from_minari(episodes):
    """Minari's episodes by name, of T + 1 observations and T actions each, as D4RL's arrays."""
    for name, episode in episodes.items():
        shapes = [np.shape(episode.get(key, ())) for key in ("observations", "actions")]
        need([*map(len, shapes)] == [2, 2] and shapes[0][0] == shapes[1][0] + 1 > 1,
             f"{name}: expected observations (T + 1, O) and actions (T, A), found "
             f"{' and '.join(map(str, shapes))}")
    actions = [np.pad(np.asarray(episode["actions"]), ((0, 1), (0, 0)))
               for episode in episodes.values()]
    ends = np.zeros(sum(map(len, actions)), bool)
    ends[np.cumsum([*map(len, actions)]) - 1] = True
    return {"observations": np.concatenate([own["observations"] for own in episodes.values()]),
            "actions": np.concatenate(actions), "timeouts": ends}


# ------------------------------------------------------------------------------ the expert

CHECKPOINTS = {".pt": read_pt, ".pth": read_pt, ".npz": read_npz, ".safetensors": read_safetensors}
REPLAYS = {".npz": read_npz, ".hdf5": read_hdf5, ".h5": read_hdf5}


@contextlib.contextmanager
def reading(path, kinds=CHECKPOINTS):
    """What a file holds, found by the end of its name; UserError, which begins with it, for all
    that goes wrong inside: a damaged file can raise nearly anything."""
    try:
        need(Path(path).is_file() and Path(path).suffix in kinds,
             f"no such file, or its name doesn't end in {', '.join(kinds)}")
        yield kinds[Path(path).suffix](Path(path))
    except fac.UserError as error:
        raise fac.UserError(f"{path}: {error}") from None
    except Exception as error:
        need(isinstance(error, MemoryError), f"{path}: not a readable {Path(path).suffix} file "
             f"({fac.shown(error)}); incomplete?")
        raise


FIRST = "_encoder.0.weight"
WRAPPERS = re.compile(r"(?:(?<=\.)|^)(?:_orig_mod|module)\.")  # torch.compile, data parallel


def state_dict(found, first=FIRST):
    """The weights in what a file holds, {name: value}: of all dicts in it, those beside `first`.
    What stands before that is taken off all; TD-MPC's `model_target` and others don't count."""
    flat, waiting, entries = {}, [("", found)], 0
    while waiting:
        prefix, values = waiting.pop()
        entries += len(values)
        need(entries <= MAX_ENTRIES, f"expected at most {MAX_ENTRIES} entries")
        for key, value in values.items():
            key = f"{prefix}{str(key)[:MAX_NAME]}"
            if type(value) is dict and len(key) < MAX_NAME:
                waiting.append((f"{key}.", value))
            elif len(key) < MAX_NAME:
                need(flat.setdefault(name := WRAPPERS.sub("", key), value) is value,
                     f"{short(name)}: two entries of this name")
    before = [key.removesuffix(first) for key in flat if ("." + key).endswith("." + first)]
    if not before:
        return flat
    models = [prefix for prefix in before if "target" not in prefix]
    need(len(models) < 2 or "model." in models or "" in models, f"several models: "
         f"{', '.join(map(short, models[:4]))}; save one of them alone")
    prefix = next((p for p in ("model.", "", *models) if p in models), "")
    beside = (*(p for p in before if len(p) > len(prefix)), *(
        f"{key}." for key, value in found.items() if type(value) is dict and not prefix))
    return {key.removeprefix(prefix): value for key, value in flat.items()
            if key.startswith(prefix) and not key.startswith(beside)}


def is_weight(value):
    """Whether it is an array of floats; u2 stands for bfloat16."""
    return type(value) is np.ndarray and value.dtype.str[1:] in ("f2", "f4", "f8", "u2")


def described(value):
    """What a message says of what a file holds under a name."""
    return (f"{value.dtype.name} {value.shape}" if type(value) is np.ndarray else
            value.reason if type(value) is Unread else
            "nothing" if value is None else type(value).__name__)


def find_sizes(state):
    """The ModelConfig that three of the weights' shapes tell."""
    shapes = []
    for key, meaning in ((FIRST, "(hidden, dim O)"), ("_encoder.2.weight", "(latent, hidden)"),
                         ("_dynamics.0.weight", "(hidden, latent + dim A)")):
        shape = getattr(state.get(key), "shape", ())
        least = shapes[1][0] if len(shapes) == 2 else 0
        need(len(shape) == 2 and shape[1] > least, f"{key}: expected a matrix {meaning}, found "
             f"{described(state.get(key))} among {', '.join(map(short, [*state][:5])) or 'nothing'}"
             f"; {ELSEWHERE}")
        shapes.append(shape)
    (enc, dim_obs), (latent, _), (hidden, joint) = shapes
    return fac.ModelConfig(dim_obs, joint - latent, 1, latent, enc, hidden)


def find_expert(path, task):
    """(sizes, {TD-MPC's name: float32 weight}, types in the file) of a checkpoint."""
    with reading(path) as found:
        state, expected = state_dict(found), {}
        sizes = find_sizes(state)
        fac.check_task(sizes, task)
        for name, i, kind, shape, _ in fac.layers(sizes, any(k.startswith("_pi.") for k in state)):
            expected[f"{name}.{i}.weight"] = shape[1:] if kind == "linear" else shape[1:2]
            expected[f"{name}.{i}.bias"] = shape[1:2]
        for key, value in state.items():  # steps and settings may be there
            need(key in expected or not is_weight(value),
                 f"{short(key)}: unknown entry; {ELSEWHERE}")
        need(sum(map(math.prod, expected.values())) <= MAX_WEIGHTS,
             f"expected at most {MAX_WEIGHTS} weights, found more")
        weights = {key: as_float32(key, state.get(key), shape) for key, shape in expected.items()}
        kinds = {state[key].dtype.newbyteorder("=").name for key in expected}
    return sizes, weights, sorted("bfloat16" if kind == "uint16" else kind for kind in kinds)


def as_float32(key, value, shape, elsewhere=ELSEWHERE):
    """A weight as the module keeps it; UserError if it is of another shape or kind."""
    need(is_weight(value) and value.shape == shape,
         f"{key}: expected floats {shape}, found {described(value)}; {elsewhere}")
    with np.errstate(over="ignore"):
        value = np.ascontiguousarray(widened(value), np.float32)
    need(np.isfinite(value).all(), f"{key}: holds values that are not finite in float32; choose "
         f"a checkpoint from before its run diverged")
    return value


def widened(value):
    """bfloat16, for which unsigned integers stand, as float32; all else as it is."""
    return (value.astype(np.uint32) << 16).view(np.float32) if value.dtype.kind == "u" else value


# ------------------------------------------------------------------------------ the replay

def find_replay(path, sizes, task=None):
    """What replay.npz needs, from an .npz or HDF5 file that holds it in any precision, by this
    project's names or D4RL's, whose actions are within a gym: task's own bounds."""
    with reading(path, REPLAYS) as found:
        if theirs := OWN["observation"] in found and "observation" not in found:
            found = from_d4rl(found)
        for key in OWN:
            need(key in found, f"{key}: not there, only {', '.join(map(short, [*found][:9]))}")
        rows = getattr(found["continues"], "size", 0)
        need(rows, "continues: expected bools, a row or more, found "
             f"{described(found['continues'])}")
        for key, kind, shape in (("continues", "bool", (rows,)),
                                 ("observation", "float", (rows, sizes.dim_obs)),
                                 ("action", "float", (rows, sizes.dim_action))):
            have = described(found[key])
            need(have.startswith(kind) and found[key].shape == shape,
                 f"{key}: expected {kind} {shape}, found {have}")
        continues = found["continues"]
        need(not continues[-1], f"continues: row {rows - 1}, the last: expected False, as in every "
             "episode's last row; cut an unfinished one off, or end it there")
        scaled = theirs and fac.is_gym(task)
        action = from_bounds(found["action"], task) if scaled else found["action"]
        action = np.where(continues[:, None], action, 0)
        fac.check_rows("action", action, 1.0005)  # as float16 rounds
        observation = fac.compact(found["observation"])
        fac.check_rows("observation", observation)
    return {"observation": observation, "action": fac.compact(np.clip(action, -1, 1)),
            "continues": continues}


def from_bounds(action, task):
    """Actions (M, A) of a gym: task's robot in [-1, 1], which stand for its bounds."""
    robot = fac.make_robot(task)
    robot.close()
    low, high = robot.bounds
    return 2 * (action - low) / np.where(high > low, high - low, 1) - 1


def from_d4rl(found):
    """D4RL's arrays by this project's names: an episode's last row is one of `terminals` or
    `timeouts`, or the file's, whose action goes unused, for what follows it isn't there."""
    there = [key for key in D4RL_ENDS if key in found]
    for key in there:  # an end that isn't read would join two episodes
        need(type(found[key]) is np.ndarray and found[key].size, f"{key}: expected numbers or "
             f"bools, found {described(found[key])}")
    ends = [np.ravel(found[key]) != 0 for key in there]
    need(ends and len({len(end) for end in ends}) == 1, f"expected {' or '.join(D4RL_ENDS)}, "
         f"equally long, found {', '.join(map(short, [*found][:9]))}")
    continues = ~np.logical_or.reduce(ends)
    continues[-1] = False
    return {"continues": continues, **{own: found[theirs] for own, theirs in OWN.items()
                                       if theirs in found}}


def collect(model, config, environment, episodes, seed):
    """(buffer, returns) of episodes that a model plays with a PlannerConfig, each with noise of
    another deviation; what the last decision of one led to isn't known."""
    seeds = fac.training_seeds(seed, "collected episode", 0, episodes)
    obs, action, reward, _ = fac.play(model, None, config, seeds, 0, "collecting", environment,
                                      MAX_NOISE)
    steps = obs.shape[1]
    buffer = ReplayBuffer(*obs.shape[2:], action.shape[2], episodes * steps, steps=steps)
    for e, n in enumerate(np.isfinite(obs[..., 0]).sum(1)):
        buffer.add(obs[e, :n], action[e, :n - 1], reward[e, :n - 1])
    return buffer, reward.sum(1).tolist()


def own_header(path):
    """What a file of this project's, which `find_expert` could read, says it was made for; {} of
    others'."""
    with contextlib.suppress(fac.UserError):
        header, _ = fac.read_npz(path, ("expert",))
        fac.made_for(header, path)
        return {k: header[k] for k in ("training", "planner", "action_repeat") if k in header}
    return {}


# ---------------------------------------------------------------------------- command line

def run(args):
    """Read everything, then write; returns what --json prints."""
    need(args.collect is None or args.collect > 1, f"--collect must be at least 2, better "
         f"{LEAST_EPISODES}: distill holds out an episode in {LEAST_EPISODES}; not {args.collect}")
    fac.lookup_task(args.task)
    sizes, weights, kinds = find_expert(args.file, args.task)
    kept = own_header(args.file) if Path(args.file).suffix == ".npz" else {}
    if args.action_repeat is None:
        default = fac.PlannerConfig(**fac.made_for({"task": args.task}, "--task"))
        args.action_repeat = kept.get("action_repeat", default.action_repeat)
    fac.PlannerConfig(action_repeat=args.action_repeat)  # refuses what is none
    environment = args.collect and fac.make_robot(args.task, args.action_repeat)  # or misses it
    arrays = args.replay and find_replay(args.replay, sizes, args.task)
    about = {"task": args.task, "imported_from": Path(args.file).name,
             "action_repeat": args.action_repeat}
    header = {**kept, "kind": "expert", "model": vars(sizes), **about}
    with fac.locked(out := Path(args.out)):
        for source, name in ((args.file, "expert.npz"), (args.replay, "replay.npz")):
            need(not source or Path(source).resolve() != (out / name).resolve(),
                 f"{source}: would be replaced by what is made of it; choose another --out")
        if (path := out / "replay.npz").exists():
            need((out / "expert.npz").exists(), f"{path}: another expert's; choose another --out")
            need(arrays or environment, f"{path}: is there from before; pass --replay or --collect "
                 "to replace it, or choose another --out")
        need(not (out / "checkpoint.npz").exists(), f"{out / 'checkpoint.npz'}: a run of "
             "train_expert.py or distill, whose files would be replaced; choose another --out")
        if (path := out / "expert.npz").exists():
            before, there = fac.read_npz(path, ("expert", "student"))
            need(before.get("task") == args.task and there.keys() == weights.keys() and all(
                np.array_equal(there[k], weights[k]) for k in there),
                f"{path}: another expert, which would be replaced; choose another --out")
            header = {**before, **header}
        if environment:
            with tempfile.TemporaryDirectory() as scratch:  # an expert is replaced with its replay
                fac.write_npz(path := Path(scratch) / "expert.npz", header, weights)
                model, made = fac.load_model(path)
                planning = fac.PlannerConfig(**fac.made_for(made, path))
                buffer, returns = collect(model, planning, environment, args.collect, args.seed)
            environment.close()
        fac.write_npz(out / "expert.npz", header, weights)
        result = {**about, "file": args.file, "out": args.out, "stored_as": kinds, "episodes": 0,
                  "weights": sum(w.size for w in weights.values()), "model": vars(sizes),
                  "policy": "_pi.0.weight" in weights, "transitions": 0, "returns": None}
        if arrays:
            fac.write_npz(out / "replay.npz", {"kind": "replay", **about}, arrays, compress=True)
        elif environment:
            buffer.write(out / "replay.npz", about)
            result["returns"] = returns
        if arrays or environment:
            replay = fac.Replay(out / "replay.npz")
            result.update(episodes=len(replay.ends), transitions=replay.transitions)
    print(report(result), file=sys.stderr)
    return result


def report(result):
    """What was imported, and what to do about what is missing."""
    sizes, episodes, returns = result["model"], result["episodes"], result["returns"]
    lines = [f"{result['out']}: {result['weights']:,} weights ({', '.join(result['stored_as'])}), "
             f"latent {sizes['latent_dim']}, hidden {sizes['enc_dim']} and {sizes['mlp_dim']}; "
             f"{result['transitions']:,} transitions in {episodes} episodes"]
    if returns:
        lines += [f"return {np.mean(returns):.0f} ± {np.std(returns):.0f}, with noise of up to "
                  f"{MAX_NOISE} on the actions"]
    if not result["policy"]:
        lines += ["no policy (_pi): planning goes without its proposals, which costs the expert "
                  "return; distill needs --policy-share 0 --expert-episodes 0 --no-priors"]
    if not episodes:
        lines += [f"distill needs --replay FILE beside --expert {result['out']}/expert.npz, or run "
                  f"this again with --collect {LEAST_EPISODES}"]
    return "\n".join(lines)


def main(argv=None):
    """Run the command line; returns the exit status."""
    parser = fac.Parser(prog="import_expert.py", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("file", metavar="FILE", help="checkpoint: " + ", ".join(CHECKPOINTS))
    parser.add_argument("--task", required=True, help="one of: " + fac.TASK_NAMES)
    parser.add_argument("--out", required=True, help="folder for expert.npz and replay.npz")
    parser.add_argument("--action-repeat", type=fac.natural, metavar="N",
                        help=f"control steps of its decisions [{fac.ACTION_REPEAT}; gym:ID 1]")
    data = parser.add_mutually_exclusive_group()
    data.add_argument("--replay", help="an .npz or HDF5 with observation, action in [-1, 1] and "
                      "continues (README), or observations, actions within a gym:ID's own bounds, "
                      "terminals, timeouts (D4RL)")
    data.add_argument("--collect", type=fac.natural, metavar="N", help="have it play N episodes")
    parser.add_argument("--seed", type=fac.natural, default=0, help="of these episodes [0]")
    parser.add_argument("--json", action="store_true", help="print JSON as stdout's last line")
    parser.set_defaults(run=run)
    try:
        return fac.run_command(parser, argv)
    except SystemExit as stop:  # --help, or a flag that isn't one
        return stop.code


if __name__ == "__main__":
    sys.exit(main())
