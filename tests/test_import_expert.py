"""Tests of data/import_expert.py: what it reads, what it refuses, and that no file runs or costs.

pytest tests/test_import_expert.py -k fuzz --fuzz 10000   # mutated files of each kind [250]
"""
import collections
import io
import itertools
import json
import pickle
import resource
import shutil
import struct
import sys
import time
import tracemalloc
import warnings
import zipfile

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import import_expert
from toys import random_model, refusal

MIB = 1 << 20
TASK, SIZES = "reacher-easy", fac.ModelConfig(8, 3, 1, 4, 5, 6)
KINDS = {"<f8": "Double", "<f4": "Float", "<f2": "Half", "<i8": "Long"}


def weights(seed=0, sizes=SIZES, policy=True, dtype=np.float32):
    """A state dict as arrays: torch's shapes and names."""
    rng, found = np.random.default_rng(seed), {}
    for name, i, kind, shape, _ in fac.layers(sizes, policy):
        found[f"{name}.{i}.weight"] = rng.standard_normal(
            shape[1:] if kind == "linear" else shape[1:2]).astype(dtype)
        found[f"{name}.{i}.bias"] = rng.standard_normal(shape[1:2]).astype(dtype)
    return found


# --------------------------------------------------------- a .pt by hand, without PyTorch


def text(value):
    return b"X" + struct.pack("<I", len(value.encode())) + value.encode()


def number(value):
    return b"J" + struct.pack("<i", value)


def pack(*values):
    """A tuple of pickled values."""
    return b"(" + b"".join(values) + b"t"


def named(name):
    module, _, attribute = name.rpartition(".")
    return f"c{module}\n{attribute}\n".encode()


def storage(key, count, kind="Float", word="storage"):
    return pack(text(word), named(f"torch.{kind}Storage"), text(str(key)), text("cpu"),
                number(count)) + b"Q"


def tensor(where, size, stride, offset=0, last=b""):
    return named("torch._utils._rebuild_tensor_v2") + pack(
        where, number(offset), pack(*map(number, size)), pack(*map(number, stride)), b"\x89",
        named("collections.OrderedDict") + b")R", last) + b"R"


def items(pairs):
    """An OrderedDict of pickled values, with the `_metadata` of a state dict."""
    return (named("collections.OrderedDict") + b")R(" + b"".join(
        text(k) + v for k, v in pairs.items()) + b"u}" + text("_metadata") + b"}sb")


def program(body):
    return b"\x80\x02" + body + b"."


def state_program(state, first=0):
    """Pickled OrderedDict of arrays; their storages are named first, first + 1, ..."""
    pairs = {}
    for key, (name, value) in zip(itertools.count(first), state.items()):
        strides = [n // value.itemsize for n in value.strides]
        pairs[name] = tensor(storage(key, value.size, KINDS[value.dtype.newbyteorder("<").str]),
                             value.shape, strides)
    return items(pairs)


def write_zip(path, members, compression=zipfile.ZIP_STORED):
    """A zip of (name, bytes) pairs, which may repeat a name."""
    with warnings.catch_warnings(), zipfile.ZipFile(path, "w", compression) as archive:
        warnings.simplefilter("ignore")
        for name, data in members.items() if isinstance(members, dict) else members:
            archive.writestr(name, data)
    return path


def write_pt(path, body, storages=(), **members):
    """A .pt with the pickle `body`, storages data/0, data/1, ... and other members."""
    return write_zip(path, {"archive/data.pkl": program(body), "archive/version": b"3\n", **members,
                            **{f"archive/data/{i}": s for i, s in enumerate(storages)}})


def write_state(path, state):
    return write_pt(path, state_program(state), [value.tobytes() for value in state.values()])


def load(path):
    """What the reader finds in a file, before it is made an expert."""
    with import_expert.reading(path) as found:
        return found


@pytest.fixture
def untouched(tmp_path):
    """A folder for files; at the end no marker has been left by something that ran."""
    marker = tmp_path / "executed"
    yield tmp_path, marker
    assert not marker.exists()


# ------------------------------------------------------------------------------ what is read


@pytest.mark.parametrize("dtype", ["<f8", "<f4", "<f2"])
@pytest.mark.parametrize("nested", [True, False])
def test_a_pt_by_hand_becomes_the_same_expert(tmp_path, dtype, nested):
    state, target = weights(dtype=dtype), weights(1, dtype=dtype)
    body = state_program(state)
    if nested:
        body = (b"}(" + text("model") + body + text("model_target")
                + state_program(target, len(state)) + b"u")
    write_pt(tmp_path / "model.pt", body,
             [v.tobytes() for v in (*state.values(), *target.values())])
    assert import_expert.main([str(tmp_path / "model.pt"), "--task", TASK, "--out",
                               str(tmp_path / "out")]) == 0
    model, header = fac.load_model(tmp_path / "out" / "expert.npz")
    assert model.config == SIZES and model.has_policy
    assert header["kind"] == "expert" and header["task"] == TASK
    for key, value in state.items():
        assert np.array_equal(model.params[key].ravel(), value.astype(np.float32).ravel())
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["expert.npz"]


def test_views_shared_storages_and_big_endian_by_hand(tmp_path):
    values = np.arange(12, dtype=np.float32) - 3.7
    body = items({"whole": tensor(storage(0, 12), (3, 4), (4, 1)),
                  "turned": tensor(storage(0, 12), (4, 3), (1, 4)),
                  "part": tensor(storage(0, 12), (2, 2), (8, 2), 1),
                  "wide": tensor(storage(0, 12), (3, 5), (1, 0), 2),
                  "one": tensor(storage(0, 12), (), (), 11),
                  "odd": tensor(storage(0, 12), (1, 2), (1 << 30, 1)),
                  "brief": tensor(storage(1, 12, "BFloat16"), (12,), (1,))})
    brief = (values.view(np.uint32) >> 16).astype(np.uint16)
    for order, name in (("<", "little"), (">", "big"), ("<", None)):
        path = write_pt(tmp_path / "views.pt", body, [values.astype(f"{order}f4").tobytes(),
                                                      brief.astype(f"{order}u2").tobytes()],
                        **({"archive/byteorder": name} if name else {}))
        found = load(path)
        grid = values.reshape(3, 4)
        assert np.array_equal(found["whole"], grid) and np.array_equal(found["turned"], grid.T)
        assert np.array_equal(found["part"], [[values[1], values[3]], [values[9], values[11]]])
        assert np.array_equal(found["wide"], np.repeat(values[2:5, None], 5, 1))
        assert found["one"] == values[11] and np.array_equal(found["odd"], [values[:2]])
        assert np.array_equal(import_expert.widened(found["brief"]).view(np.uint32),
                              values.view(np.uint32) >> 16 << 16)


@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", ">f4", "<f2", ">f2"])
@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_an_npz_becomes_the_same_expert(tmp_path, dtype, save):
    state = weights(dtype=dtype)
    state["_pi.0.weight"] = np.asfortranarray(state["_pi.0.weight"])
    save(tmp_path / "model.npz", **{f"model.{k}": v for k, v in state.items()},
         **{f"model_target.{k}": v for k, v in weights(1).items()})
    sizes, found, kinds = import_expert.find_expert(tmp_path / "model.npz", TASK)
    assert sizes == SIZES and kinds == [np.dtype(dtype).newbyteorder("=").name]
    for key, value in state.items():
        assert found[key].dtype == np.float32 and found[key].dtype.isnative
        assert np.array_equal(found[key], value.astype(np.float32))


def test_an_expert_of_this_project_can_be_read_again(tmp_path):
    np.savez(tmp_path / "a.npz", **weights())
    command = ["--task", TASK, "--out"]
    assert import_expert.main([str(tmp_path / "a.npz"), *command, str(tmp_path / "b")]) == 0
    before = fac.load_model(tmp_path / "b" / "expert.npz")[0]
    own = str(tmp_path / "b" / "expert.npz")
    assert import_expert.main([own, *command, str(tmp_path / "c")]) == 0
    after = fac.load_model(tmp_path / "c" / "expert.npz")[0]
    assert all(np.array_equal(after.params[k], v) for k, v in before.params.items())


def test_a_training_run_is_not_replaced(tmp_path, capsys):
    np.savez(tmp_path / "a.npz", **weights())
    (tmp_path / "checkpoint.npz").touch()
    assert import_expert.main([str(tmp_path / "a.npz"), "--task", TASK, "--collect", "2", "--out",
                               str(tmp_path)]) == 2
    assert "checkpoint.npz: a run of train_expert.py" in capsys.readouterr().err
    assert not (tmp_path / "expert.npz").exists()


def test_torch_files_agree_bit_for_bit(tmp_path):
    torch = pytest.importorskip("torch")
    torch.manual_seed(0)
    base = torch.randn(6, 8)
    state = collections.OrderedDict(plain=base, row=base[2], turned=base.t(), part=base[1::2, 3:7],
                                    wide=base[:, :1].expand(6, 5), scalar=torch.tensor(2.5),
                                    parameter=torch.nn.Parameter(torch.randn(3)),
                                    count=torch.tensor(7))
    for name in ("float64", "float16", "bfloat16"):
        value = torch.randn(9, 4).to(getattr(torch, name))
        state.update({name: value, f"{name} part": value[2:, 1]})
    layers = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.LayerNorm(4))
    for saved in (state, layers.state_dict(), {"model": layers.state_dict(), "model_target": state},
                  dict(layers.named_parameters())):
        torch.save(saved, tmp_path / "model.pt")
        expected = torch.load(tmp_path / "model.pt", weights_only=True)
        for order in ("little", "big"):
            swapped = swap_bytes(tmp_path / "model.pt", tmp_path / "big.pt")
            found = load(swapped if order == "big" else tmp_path / "model.pt")
            pairs = [(expected, found)]
            if "model" in saved:
                pairs = [(expected[k], found[k]) for k in ("model", "model_target")]
            for theirs, ours in pairs:
                assert list(theirs) == list(ours)
                for key, value in theirs.items():
                    kind = torch.float32 if value.dtype == torch.bfloat16 else value.dtype
                    value = value.detach().to(kind).numpy()
                    mine = import_expert.widened(ours[key]).astype(value.dtype)  # native order
                    assert mine.shape == value.shape and mine.tobytes() == value.tobytes()


def swap_bytes(path, out):
    """A file as a big-endian machine writes it."""
    widths = {}

    class Reader(pickle.Unpickler):  # learns the storages' widths
        def persistent_load(self, found):
            widths[found[2]] = {"D": 8, "L": 8, "F": 4, "H": 2, "B": 2}[found[1][0]]

        def find_class(self, module, name):
            return (collections.OrderedDict if name == "OrderedDict" else
                    name if name.endswith("Storage") else lambda *_: None)

    with zipfile.ZipFile(path) as archive:
        members = {m.filename: archive.read(m) for m in archive.infolist()}
    Reader(io.BytesIO(next(d for n, d in members.items() if n.endswith("/data.pkl")))).load()
    for name, data in members.items():
        folder, _, key = name.rpartition("/")
        if folder.endswith("/data"):
            members[name] = np.frombuffer(data, f"u{widths[key]}").byteswap().tobytes()
        elif key == "byteorder":
            members[name] = b"big"
    return write_zip(out, members)


def official_networks(dim_obs, dim_action, latent, enc, hidden):
    """TD-MPC's networks as its public code builds them, under the names of its state dict."""
    from torch import nn

    def mlp(inputs, outputs):
        return nn.Sequential(nn.Linear(inputs, hidden), nn.ELU(), nn.Linear(hidden, hidden),
                             nn.ELU(), nn.Linear(hidden, outputs))

    def q():
        return nn.Sequential(nn.Linear(latent + dim_action, hidden), nn.LayerNorm(hidden),
                             nn.Tanh(), nn.Linear(hidden, hidden), nn.ELU(), nn.Linear(hidden, 1))

    return nn.ModuleDict({
        "_encoder": nn.Sequential(nn.Linear(dim_obs, enc), nn.ELU(), nn.Linear(enc, latent)),
        "_dynamics": mlp(latent + dim_action, latent), "_reward": mlp(latent + dim_action, 1),
        "_pi": mlp(latent, dim_action), "_Q1": q(), "_Q2": q()})


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
@pytest.mark.parametrize("dtype", ["float64", "float32", "float16", "bfloat16"])
def test_an_imported_expert_computes_what_torch_does(tmp_path, suffix, dtype):
    torch = pytest.importorskip("torch")
    torch.manual_seed(1)
    told = official_networks(8, 3, 4, 5, 6)
    with torch.no_grad():
        for p in told.parameters():
            p.add_(0.1 * torch.randn_like(p))
    told = told.to(getattr(torch, dtype))
    path = tmp_path / f"model{suffix}"
    if suffix == ".pt":
        torch.save({"model": told.state_dict(), "model_target": told.state_dict()}, path)
    else:
        pytest.importorskip("safetensors.torch").save_file(told.state_dict(), path)
    assert import_expert.main([str(path), "--task", TASK, "--out", str(tmp_path / "out")]) == 0
    model, _ = fac.load_model(tmp_path / "out" / "expert.npz")
    rng = np.random.default_rng(0)
    obs, action = rng.standard_normal((8, 7), np.float32), rng.uniform(-1, 1, (3, 7))
    action, told = action.astype(np.float32), told.float()
    with torch.no_grad():
        z = told["_encoder"](torch.tensor(obs.T))
        x = torch.cat([z, torch.tensor(action.T)], 1)
        theirs = [z.T, *(told[name](x).T for name in ("_dynamics", "_reward", "_Q1", "_Q2")),
                  torch.tanh(told["_pi"](z)).T]
    latent, a = model.encode(obs), action[None]
    ours = [latent, model.next(latent, a), model.reward(latent, a), *model.q(latent, a),
            model.policy(latent)]
    for mine, other in zip(ours, theirs):
        assert np.allclose(mine[0], other.numpy().reshape(mine[0].shape), rtol=0, atol=1e-6)


def test_safetensors_by_hand_and_without_the_library(tmp_path, monkeypatch):
    write_safetensors(tmp_path / "model.safetensors", weights())
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "safetensors", None)
        refusal(lambda: import_expert.find_expert(tmp_path / "model.safetensors", TASK),
                "model.safetensors", "pip install 'fac-tdmpc-ref[safetensors]'")
    pytest.importorskip("safetensors")
    _, found, kinds = import_expert.find_expert(tmp_path / "model.safetensors", TASK)
    assert kinds == ["float32"]
    assert all(np.array_equal(found[k], v) for k, v in weights().items())
    write_safetensors(tmp_path / "model.safetensors", {**weights(), "step": np.zeros(1, "i8")})
    assert import_expert.find_expert(tmp_path / "model.safetensors", TASK)[2] == ["float32"]
    other = {**weights(), "_pi.0.bias": np.zeros(6, "i8")}
    write_safetensors(tmp_path / "model.safetensors", other)
    refusal(lambda: import_expert.find_expert(tmp_path / "model.safetensors", TASK),
            "_pi.0.bias: expected floats (6,), found I64 [6]")


def write_safetensors(path, state):
    """The format by hand: length of the JSON header, header, data."""
    header, start = {}, 0
    for name, value in state.items():
        header[name] = {"dtype": {"f": "F32", "i": "I64"}[value.dtype.kind],
                        "shape": value.shape,
                        "data_offsets": [start, start + value.nbytes]}
        start += value.nbytes
    encoded = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(encoded)) + encoded
                     + b"".join(v.tobytes() for v in state.values()))
    return path


# --------------------------------------------------------------------------- what is refused


def changed(change):
    state = weights()
    change(state)
    return state


@pytest.mark.parametrize("change, parts", [
    (lambda s: s.update({"_Q3.0.weight": s["_Q1.0.weight"]}), ["'_Q3.0.weight'", "unknown entry"]),
    (lambda s: s.pop("_Q2.3.bias"), ["_Q2.3.bias", "expected floats (6,)", "found nothing"]),
    (lambda s: s.pop("_pi.2.weight"), ["_pi.2.weight", "expected floats (6, 6)", "nothing"]),
    (lambda s: s.pop("_encoder.0.weight"), ["_encoder.0.weight", "(hidden, dim O)", "nothing"]),
    (lambda s: s.update({"_encoder.2.weight": np.zeros((4, 3, 2, 2), np.float32)}),
     ["_encoder.2.weight", "expected a matrix", "(4, 3, 2, 2)", "state input"]),
    (lambda s: s.update({"_dynamics.0.weight": np.zeros((6, 4), np.float32)}),
     ["_dynamics.0.weight", "(hidden, latent + dim A)", "(6, 4)"]),
    (lambda s: s.update({"_Q1.1.weight": np.zeros(7, np.float32)}),
     ["_Q1.1.weight", "expected floats (6,)", "float32 (7,)"]),
    (lambda s: s.update({"_Q1.1.weight": np.zeros(6, np.int64)}), ["_Q1.1.weight", "int64"]),
    (lambda s: s["_reward.2.bias"].__setitem__(3, np.nan), ["_reward.2.bias", "not finite"]),
    (lambda s: s.update({"_reward.2.bias": np.full(6, 1e300)}), ["_reward.2.bias", "not finite"]),
    (lambda s: s.update({"_encoder.0.weight": np.zeros((5, 9), np.float32)}),
     ["(9, 3)", "reacher-easy", "(8, 3)"]),
])
def test_other_state_dicts_are_refused_by_name(tmp_path, change, parts):
    path = write_state(tmp_path / "model.pt", changed(change))
    refusal(lambda: import_expert.find_expert(path, TASK), path, *parts)


PREFIXES = ["", "model.", "_orig_mod.", "module.", "model._orig_mod.", "model.module.",
            "state_dict.", "agent.model.", "module._orig_mod.agent.model.module."]


@pytest.mark.parametrize("prefix", PREFIXES)
@pytest.mark.parametrize("suffix", [".npz", ".pt"])
def test_what_wrappers_put_before_the_names_is_taken_off(tmp_path, prefix, suffix):
    """And what lies beside the weights: the slow copy, a counter, settings."""
    state = {prefix + name: value for name, value in weights().items()}
    slow = {f"{prefix}model_target.{name}": value for name, value in weights(1).items()}
    state = {**slow, **state, **({"step": np.array([3])} if suffix == ".npz" else {})}
    path = tmp_path / f"model{suffix}"
    np.savez(path, **state) if suffix == ".npz" else write_state(path, state)
    _, found, _ = import_expert.find_expert(path, TASK)
    assert all(np.array_equal(found[name], value) for name, value in weights().items())


def test_wrappers_within_a_name_and_dicts_within_dicts(tmp_path):
    torch = pytest.importorskip("torch")
    networks = official_networks(8, 3, 4, 5, 6)
    expected = {k: v.clone() for k, v in networks.state_dict().items()}
    adam = torch.optim.Adam(networks.parameters())
    networks["_encoder"](torch.ones(1, 8)).sum().backward()
    adam.step()
    expected = {k: v.clone() for k, v in networks.state_dict().items()}
    inner = {k.replace("_encoder.", "_encoder._orig_mod."): v for k, v in expected.items()}
    beside = {"step": 1000, "lr": 1e-3, "optimizer": adam.state_dict(), "config": {
        "task": "walker-walk", "sizes": [50, 256], "seed": None, "nested": {"a": {"b": [1.0]}}},
        "began": 2 ** 60, "rng": torch.get_rng_state(), "done": torch.tensor(True),
        "count": torch.tensor(3, dtype=torch.int32)}
    for saved in ({"model": expected, **beside}, {**expected, **beside}, {**inner, "step": 3},
                  {"agent": {"model": {f"module.{k}": v for k, v in inner.items()},
                             "model_target": networks.state_dict()}, **beside}):
        torch.save(saved, tmp_path / "model.pt")
        _, found, _ = import_expert.find_expert(tmp_path / "model.pt", TASK)
        assert all(np.array_equal(found[k], v.numpy()) for k, v in expected.items())


@pytest.mark.parametrize("state, parts", [
    ({"encoder.0.weight": np.zeros((5, 8), "f4"), "pi.weight": np.zeros(3, "f4")},
     ["_encoder.0.weight", "nothing among 'encoder.0.weight', 'pi.weight'"]),
    ({f"{agent}.{k}": v for agent in ("a", "b") for k, v in [("_encoder.0.weight", np.ones(3))]},
     ["several models: 'a.', 'b.'", "one of them alone"]),
    ({"_encoder.0.weight": np.ones(3), "module._encoder.0.weight": np.zeros(3)},
     ["'_encoder.0.weight': two entries"])])
def test_which_names_were_found_is_said(tmp_path, state, parts):
    np.savez(tmp_path / "model.npz", **state)
    refusal(lambda: import_expert.find_expert(tmp_path / "model.npz", TASK), *parts)


def test_names_of_another_method_in_a_model_are_said(tmp_path):
    torch = pytest.importorskip("torch")
    torch.save({"model": {"_encoder.state.0.weight": torch.zeros(4, 8)}}, tmp_path / "model.pt")
    refusal(lambda: import_expert.find_expert(tmp_path / "model.pt", TASK),
            "nothing among 'model._encoder.state.0.weight'", "only TD-MPC's official")


def test_an_expert_without_policy_is_imported_with_a_word(tmp_path, capsys):
    write_state(tmp_path / "model.pt", weights(policy=False))
    assert import_expert.main([str(tmp_path / "model.pt"), "--task", TASK, "--out",
                               str(tmp_path), "--json"]) == 0
    out, err = capsys.readouterr()
    assert "no policy (_pi)" in err and f"--collect {import_expert.LEAST_EPISODES}" in err
    result = json.loads(out)
    assert result["policy"] is False and result["model"]["mlp_dim"] == 6
    assert not fac.load_model(tmp_path / "expert.npz")[0].has_policy


@pytest.mark.parametrize("name, data, parts", [
    ("model.pt", b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.", ["older than PyTorch 1.6", "save"]),
    ("model.pt", b"PK\x03\x04 and no more", ["not a readable"]),
    ("model.npz", b"", ["not a readable"]),
    ("model.pkl", b"", ["doesn't end in .pt, .pth, .npz, .safetensors"]),
    ("missing.pt", None, ["no such file"]),
])
def test_other_files_are_refused(tmp_path, name, data, parts):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    refusal(lambda: load(tmp_path / name), tmp_path / name, *parts)


def test_the_command_line_refuses_in_one_line_and_writes_nothing(tmp_path, capsys):
    model = write_state(tmp_path / "model.pt", weights())
    out = ["--out", str(tmp_path / "out")]
    for arguments, part in ((["--task", "walker-wark"], "did you mean 'walker-walk'"),
                            (["--task", "walker-walk"], "(24, 6)"),
                            (["--task", TASK, "--collect", "1"], "--collect must be at least 2"),
                            (["--task", TASK, "--replay", "none.npz"], "none.npz: no such file"),
                            (["--task", TASK, "--replay", "a", "--collect", "9"], "not allowed"),
                            ([], "--task")):
        assert import_expert.main([str(model), *out, *arguments]) == 2
        assert part in capsys.readouterr().err.splitlines()[-1]
        assert not (tmp_path / "out").exists()


# --------------------------------------------------------------------------------- hostile


class Calls:
    """Pickles as a call."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call


FLOATS = np.ones(6, np.float32).tobytes()
GOOD = tensor(storage(0, 6), (2, 3), (3, 1))
CREATE = "open({!r}, 'w').close()"


EXEC = b"c__builtin__\nexec\n"
RUN = {  # opcodes that run code, what is refused, and whether pickle itself runs this one
    "REDUCE": (lambda call: EXEC + call + b"\x85R", "asks for '__builtin__ exec'", True),
    "INST": (lambda call: b"(" + call + b"i__builtin__\nexec\n", "opcode INST", True),
    "OBJ": (lambda call: b"(" + EXEC + call + b"o", "asks for", True),
    "bare OBJ": (lambda call: b"(" + call + call + b"o", "opcode OBJ", False),
    "NEWOBJ": (lambda call: named("collections.OrderedDict") + b")\x81", "opcode NEWOBJ", False),
    "STACK_GLOBAL": (lambda call: text("builtins") + text("exec") + b"\x93" + call + b"\x85R",
                     "opcode STACK_GLOBAL", True),
    "SHORT_BINUNICODE": (lambda call: b"\x8c\x08builtins\x8c\x04exec\x93" + call + b"\x85R",
                         "opcode SHORT_BINUNICODE", True),
    "EXT1": (lambda call: b"\x82\x01)R", "opcode EXT1", False),
}


@pytest.mark.parametrize("opcode", RUN)
def test_no_opcode_runs_anything(untouched, opcode):
    folder, marker = untouched
    make, part, runs = RUN[opcode]
    body, path = make(text(CREATE.format(str(marker)))), folder / "model.pt"
    if runs:  # it is in earnest
        pickle.loads(program(body))
        marker.unlink()
    for hidden in (body, b"}" + text("model") + body + b"s", items({"a": GOOD, "b": body})):
        write_pt(path, hidden, [FLOATS])
        refusal(lambda: load(path), path, part, "nothing of it was run")


HOSTILE = {
    "state of an array": (b"}" + text("a") + GOOD + b"}b" + b"s", "sets a state"),
    "state of a storage": (storage(0, 6) + b"}b", "sets a state"),
    "state of a name": (named("collections.OrderedDict") + b"}b", "sets a state"),
    "items of an array": (GOOD + text("a") + b"Ns", "sets other items"),
    "items of a tuple": (b")(" + text("a") + b"Nu", "sets other items"),
    "items of a name": (named("torch.FloatStorage") + text("a") + b"Ns", "sets other items"),
    "half an item": (b"}(" + text("a") + b"u", "sets other items"),
    "a tuple as key": (b"})Ns", "sets other items"),
    "a call of a storage": (named("torch.FloatStorage") + b")R", "calls something"),
    "a call of a dtype": (named("torch.float32") + b")R", "calls something"),
    "a call of a dict": (b"})R", "calls something"),
    "a call with a dict": (named("collections.OrderedDict") + b"}R", "calls something"),
    "OrderedDict of items": (named("collections.OrderedDict") + b")\x85R", "calls something"),
    "an attribute": (named("collections.OrderedDict.fromkeys"), "asks for"),
    "a module of ours": (named("fac_tdmpc_ref.save_model"), "asks for"),
    "more than the bytes": (tensor(storage(0, 7), (7,), (1,)), "declares 7 elements"),
    "fewer than the bytes": (tensor(storage(0, 5), (5,), (1,)), "declares 5 elements"),
    "a negative count": (tensor(storage(0, -6), (6,), (1,)), "declares -6 elements"),
    "another type of storage": (tensor(storage(0, 6, "Double"), (6,), (1,)), "of 8 bytes"),
    "an absent storage": (tensor(storage(1, 6), (6,), (1,)), "damaged"),
    "a storage elsewhere": (storage("../version", 2), "damaged"),
    "another persistent id": (storage(0, 6, word="file"), "refers to something"),
    "a bare persistent id": (text("data/0") + b"Q", "refers to something"),
    "strides that leave": (tensor(storage(0, 6), (2, 3), (4, 1)), "reaches out"),
    "an offset that leaves": (tensor(storage(0, 6), (6,), (1,), 1), "reaches out"),
    "a negative offset": (tensor(storage(0, 6), (2,), (1,), -1), "odd tensor"),
    "a negative stride": (tensor(storage(0, 6), (2,), (-1,), 5), "odd tensor"),
    "a negative size": (tensor(storage(0, 6), (-2,), (1,)), "odd tensor"),
    "no elements": (tensor(storage(0, 6), (0, 6), (1, 1)), "empty"),
    "a vast expansion": (tensor(storage(0, 6), (1 << 30, 1 << 30), (0, 0)), "too large"),
    "a large expansion": (tensor(storage(0, 6), (1 << 26,), (0,)), "too large"),
    "a bool as size": (named("torch._utils._rebuild_tensor_v2") + pack(
        storage(0, 6), number(0), b"\x88\x85", b"\x88\x85", b"\x89", b"}") + b"R", "odd tensor"),
    "many dimensions": (tensor(storage(0, 6), [1] * 9, [1] * 9), "odd tensor"),
    "sizes without strides": (tensor(storage(0, 6), (2, 3), (3,)), "odd tensor"),
    "a negated view": (tensor(storage(0, 6), (6,), (1,), 0, b"}" + text("neg") + b"\x88s"),
                       "odd tensor"),
    "a tensor of a tensor": (tensor(GOOD, (6,), (1,)), "odd tensor"),
    "too few arguments": (named("torch._utils._rebuild_tensor_v2") + storage(0, 6) + b"\x85R",
                          "calls something"),
    "an empty stack": (b"", "something else than a dict"),
    "two values": (b"}}", "something else than a dict"),
    "a MARK that stays": (b"(}", "something else than a dict"),
    "a TUPLE without MARK": (b"t", "damaged"),
    "pops from nothing": (b"}b", "sets a state"),
    "an absent memo": (b"h\x00", "damaged"),
    "a text without end": (b"X\xff\xff\xff\xffabc", "damaged"),
    "a text of 2 ** 63": (b"\x8d" + b"\xff" * 7 + b"\x7fabc", "opcode BINUNICODE8"),
    "a long of 2 ** 31": (b"\x8b\xff\xff\xff\x7fabc", "opcode LONG4"),
    "bytes": (b"\x96" + struct.pack("<Q", 3) + b"abc", "opcode BYTEARRAY8"),
    "digits": (b"L" + b"9" * 4000 + b"L\n", "opcode LONG"),
    "an unknown opcode": (b"\xff", "opcode b'\\xff'"),
    "protocol 4": (b"\x80\x04}", "another protocol"),
    "a list": (b"]", "something else than a dict"),
    "one more of a dict": (b"}Na", "adds to something else than a list"),
    "more of a tuple": (b")(NNe", "adds to something else than a list"),
    "more of nothing": (b"Na", "damaged"),
    "a list as key": (b"}]Ns", "sets other items"),
    "a float as key": (b"}G" + struct.pack(">d", 1) + b"Ns", "sets other items"),
    "a list as arguments": (named("collections.OrderedDict") + b"]R", "calls something"),
    "a list as size": (named("torch._utils._rebuild_tensor_v2") + pack(
        storage(0, 6), number(0), b"](K\x06e", pack(number(1)), b"\x89", b"}") + b"R",
        "odd tensor"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused(tmp_path, name):
    body, part = HOSTILE[name]
    path = write_pt(tmp_path / "model.pt", body, [FLOATS])
    refusal(lambda: load(path), path, "data.pkl", part)


def limited(call, mebibytes):
    """The outcome of a call that must not take more memory than that: a value or a UserError."""
    tracemalloc.start()
    try:
        return call()
    except fac.UserError as error:
        assert len(str(error)) < 1000 and "\n" not in str(error) and str(error).isprintable()
        return error
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < mebibytes * MIB


HALF = import_expert.MAX_HEADER // 2 - 50
TENSORS = (storage(0, 1 << 18) + b"q\x000" + named("torch._utils._rebuild_tensor_v2") + b"q\x010"
           + pack(number(1 << 25)) + b"q\x020" + pack(number(0)) + b"q\x030")
DOUBLE = b"0}(" + text("a") + b"h\x00" + text("b") + b"h\x00uq\x00"  # twice the dict before
BOMBS = {
    "nested tuples": b"}" + b"\x85" * HALF + text("a"),
    "tuples that double": b")" + b"q\x00h\x00\x86" * (HALF // 3),
    "as a name": b"})" + b"q\x00h\x00\x86" * (HALF // 4) + b"Ns",
    "as a size": tensor(storage(0, 6), (1,), (1,))[:-3] + b")" + b"q\x00h\x00\x86" * 5000 + b"R",
    "as a result": b"}" + text("a") + b")" + b"q\x00h\x00\x86" * (HALF // 4) + b"s",
    "nested dicts": b"}" + (text("") + b"}") * (HALF // 4) + b"s" * (HALF // 8),
    "a dict in itself": b"}q\x00" + text("a") + b"h\x00s",
    "lists": b"(" + b"]" * HALF + b"t",
    "a list in itself": b"}" + text("a") + b"]q\x00h\x00as",
    "many of one list": b"}" + text("a") + b"](" + b"N" * HALF + b"es",
    "dicts that double": b"}q\x00" + DOUBLE * (HALF // 15),
    "marks": b"(" * 2 * HALF,
    "dicts": b"(" + b"}" * HALF + b"t",
    "memo": b"}" + b"".join(b"r" + struct.pack("<I", i * 60013 % (1 << 32))
                            for i in range(HALF // 3)),
    "texts": b"}(" + b"".join(text(str(i)) + b"N" for i in range(HALF // 6)) + b"u",
    "one long text": text("\x1b]0;\n" * (HALF // 3)),
    "names": named("torch.FloatStorage") * (HALF // 10),
    "storages": b"}" + storage(0, 6)[:-1] + b"q\x00Q" + b"h\x00Q" * (HALF // 3),
    "expansions": b"}(" + b"".join(text(str(i)) + tensor(storage(0, 6), (1 << 25,), (0,))
                                   for i in range(HALF // 120)) + b"u",
    "more than the limit": b"}" + b"N" * 3 * HALF,
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_cost_little(tmp_path, name):
    path = write_pt(tmp_path / "model.pt", BOMBS[name], [FLOATS])
    began = time.process_time()
    found = limited(lambda: import_expert.find_expert(path, TASK), 32)
    assert isinstance(found, fac.UserError)
    assert time.process_time() - began < 10


def test_a_long_pickle_is_not_even_begun():
    data = pickle.dumps({}, 2)  # which is fine, as is what follows its end
    assert import_expert.read_pickle(data, {}, "<") == {}
    longer = data + bytes(import_expert.MAX_HEADER + 1 - len(data))
    refusal(lambda: import_expert.read_pickle(longer, {}, "<"), "more than")


def test_expansions_of_weights_are_bounded(tmp_path):
    """Every weight a view of one number; sizes whose networks would take gigabytes."""
    for hidden, part in ((6, None), (1 << 13, "weights")):
        sizes = fac.ModelConfig(8, 3, 1, 4, 5, hidden)
        shapes = {}
        for name, i, kind, shape, _ in fac.layers(sizes, False):
            shapes[f"{name}.{i}.weight"] = shape[1:] if kind == "linear" else shape[1:2]
            shapes[f"{name}.{i}.bias"] = shape[1:2]
        body = items({k: tensor(storage(0, 1, "BFloat16"), s, [0] * len(s))
                      for k, s in shapes.items() if part is None or math_prod(s) <= 1 << 25})
        path = write_pt(tmp_path / "model.pt", body, [b"\x80\x3f"])
        found = limited(lambda path=path: import_expert.find_expert(path, TASK), 8)
        if part is None:
            assert all((value == 1).all() for value in found[1].values())
        else:
            assert part in str(found)


def math_prod(shape):
    return int(np.prod(shape, dtype=np.int64))


@pytest.mark.parametrize("suffix", [".pt", ".npz"])
def test_zip_bombs_and_odd_archives_are_refused(tmp_path, suffix):
    path, good = tmp_path / f"model{suffix}", {"archive/data.pkl": program(b"}")}
    zeros = bytes(80 * MIB)
    write_zip(path, {**good, "archive/data/0": zeros}, zipfile.ZIP_DEFLATED)
    assert "unpack to" in str(limited(lambda: load(path), 4))
    lie = bytearray(path.read_bytes())  # now it declares 10 bytes
    for at, width in ((lie.rindex(b"PK\x01\x02") + 24, 4), (lie.rindex(b"PK\x03\x04") + 22, 4)):
        lie[at:at + width] = struct.pack("<I", 10)
    path.write_bytes(lie)
    assert "not a readable" in str(limited(lambda: load(path), 4))
    write_zip(path, [*good.items(), *good.items()])
    assert "two members of this name" in str(limited(lambda: load(path), 4))
    write_zip(path, {**good, **{str(i): b"" for i in range(5000)}})
    assert "members" in str(limited(lambda: load(path), 16))
    write_zip(path, {**good, **{str(i): b"" for i in range(50_000)}})
    assert "table of contents" in str(limited(lambda: load(path), 16))
    write_zip(path, good, zipfile.ZIP_LZMA)
    assert "deflate" in str(limited(lambda: load(path), 4))
    write_zip(path, good)
    secret = bytearray(path.read_bytes())
    secret[secret.rindex(b"PK\x01\x02") + 8] |= 1
    path.write_bytes(secret)
    assert "encrypted" in str(limited(lambda: load(path), 4))


def npy(header, data=b""):
    header = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + data


@pytest.mark.parametrize("member", [
    npy("{'descr': '<f4', 'fortran_order': False, 'shape': (999999999, 999999999), }"),
    npy("{'descr': '<f4', 'fortran_order': False, 'shape': (3,), }", b"1234"),
    npy("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }", b"1234"),
    npy("{'descr': '<f4', 'fortran_order': False, 'shape': (" + "1, " * 9 + "1), }", b"1234"),
    npy("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        pickle.dumps(Calls(eval, ("1/0",)))),
    npy("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (1,), }", b"1234"),
    npy("{'descr': '<f4', 'fortran_order': False, 'shape': " + "(" * 9000 + "}"),
    npy("{'descr': '<f4', 'fortran_order': __import__('os').abort(), 'shape': (1,), }", b"1234"),
    b"\x93NUMPY\x01\x00\xff\xff{'descr'", b"", b"text",
])
def test_odd_arrays_are_refused(tmp_path, member):
    """Where they are needed; beside what is, they aren't read."""
    np.savez(tmp_path / "good.npz", **weights())
    with zipfile.ZipFile(tmp_path / "good.npz") as archive:
        good = {name: archive.read(name) for name in archive.namelist()}
    for name in ("_encoder.0.weight", "_Q2.3.bias", "a"):
        write_zip(tmp_path / "model.npz", {**good, f"{name}.npy": member})
        found = limited(lambda: import_expert.find_expert(tmp_path / "model.npz", TASK), 4)
        assert name == "a" or isinstance(found, fac.UserError) and f"{name}: exp" in str(found)
    assert found[0] == SIZES


def test_odd_names_in_messages_are_escaped(tmp_path):
    state = {**weights(), "\x1b[31m\nred\u202e": np.zeros(1, np.float32)}
    path = write_state(tmp_path / "model.pt", state)
    refusal(lambda: import_expert.find_expert(path, TASK), r"\x1b[31m\nred\u202e")


# -------------------------------------------------------------------------------------- fuzz


def mutate(rng, data):
    """Flips, cuts, insertions, repetitions and interesting numbers, one to a few of them."""
    data = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 3])):
        at, length = (int(n) for n in rng.integers(0, (len(data) + 1, 40)))
        kind = rng.choice(6, p=[0.3, 0.1, 0.1, 0.1, 0.1, 0.3])
        if kind == 0 and data:
            data[at % len(data)] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del data[at:at + length]
        elif kind == 2:
            data[at:at] = rng.bytes(length)
        elif kind == 3:
            data[at:at] = data[at:at + length]
        elif kind == 4:
            data[at:at + 4] = struct.pack("<I", rng.choice([0, 1, (1 << 31) - 1, (1 << 32) - 1]))
        elif rng.random() < 0.2:
            del data[at:]
        elif data:
            data[at % len(data)] = int(rng.choice(list(b"(.0123}]btsuRQcqhX\x80\x85\x8a\x93")))
    return bytes(data)


PARTS = [b"(", b"(", b"t", b"}", b"}", b")", b"N", b"\x88", b"s", b"u", b"b", b"R", b"Q", b"\x85",
         b"\x86", b"\x87", b"q\x00", b"q\x01", b"r\x02\x00\x00\x00", b"h\x00", b"h\x01",
         b"j\x02\x00\x00\x00", GOOD, GOOD, storage(0, 6), storage(0, 6)[:-1], number(0), number(6),
         number(-1), b"K\x01", text("a"), text("model"), text("_pi.0.bias"),
         named("collections.OrderedDict"), named("torch.FloatStorage"), pack(number(2), number(3)),
         named("torch._utils._rebuild_tensor_v2"), named("torch._utils._rebuild_parameter"),
         items({"a": GOOD}), text("b") + GOOD + b"s", storage(0, 6) + number(0) + b")"]


def random_program(rng):
    """A .pt whose pickle strings sound opcodes together at random, on a dict."""
    buffer = io.BytesIO()
    write_pt(buffer, b"}" + b"".join(PARTS[i] for i in rng.integers(len(PARTS), size=rng.integers(
        1, 9))), [FLOATS])
    return buffer.getvalue()


def mutated_members(rng, members, name):
    """A zip whose checksums are right, with one member mutated."""
    buffer = io.BytesIO()
    write_zip(buffer, {**members, name: mutate(rng, members[name])})
    return buffer.getvalue()


def fuzzed(folder, kind):
    """A function of a generator that makes a mutated file's bytes, and the file's ending."""
    suffix = kind.split()[-1]
    if kind.startswith("program"):
        return random_program, suffix
    path = folder / f"model{suffix}"
    if suffix == ".pt":
        write_state(path, weights())
    elif suffix == ".npz":
        np.savez_compressed(path, **weights())
    else:
        write_safetensors(path, weights())
    original = path.read_bytes()
    if not kind.startswith("member"):
        return lambda rng: mutate(rng, original), suffix
    with zipfile.ZipFile(path) as archive:
        members = {m.filename: archive.read(m) for m in archive.infolist()}
    chosen = ["archive/data.pkl"] if suffix == ".pt" else list(members)
    return lambda rng: mutated_members(rng, members, str(rng.choice(chosen))), suffix


@pytest.mark.parametrize("kind", ["file .pt", "member .pt", "program .pt", "file .npz",
                                  "member .npz", "file .safetensors"])
def test_fuzz(tmp_path, kind, capsys, pytestconfig):
    """Every outcome is an import or a UserError; no file beside; less than 32 MiB a file."""
    if kind.endswith("safetensors"):
        pytest.importorskip("safetensors")
    files = pytestconfig.getoption("fuzz")
    (tmp_path / "in").mkdir()
    make, suffix = fuzzed(tmp_path / "in", kind)
    complete = not kind.startswith("program")  # one that holds an expert to begin with
    counts, began = collections.Counter(), time.perf_counter()
    path, highest = tmp_path / "in" / f"mutated{suffix}", 0
    tracemalloc.start()
    for seed in range(files):
        path.write_bytes(make(np.random.default_rng([seed, len(kind)])))
        tracemalloc.reset_peak()
        status = import_expert.main([str(path), "--task", TASK, "--out", str(tmp_path / "out")])
        highest = max(highest, tracemalloc.get_traced_memory()[1])
        counts[status] += 1
        assert status in (0, 2)
    tracemalloc.stop()
    errors = capsys.readouterr().err
    assert errors.count("import_expert.py: error: ") == counts[2] and "Traceback" not in errors
    assert highest < 32 * MIB
    assert counts[2] and (counts[0] or not complete or files < 250)
    assert {p.name for p in tmp_path.iterdir()} <= {"in", "out"}
    assert {p.name for p in (tmp_path / "in").iterdir()} <= {f"model{suffix}", path.name}
    assert not counts[0] or {p.name for p in (tmp_path / "out").iterdir()} == {"expert.npz"}
    with capsys.disabled():
        if files > 250:
            rss = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            print(f"\n{kind}: {counts[0]} loaded, {counts[2]} refused, 0 others; at most "
                  f"{highest / MIB:.1f} MiB a file, {rss} MiB the process; "
                  f"{time.perf_counter() - began:.0f} s")


# ------------------------------------------------------------------------------- the replay


def replay_arrays(episodes=20, rows=7, dtype=np.float64):
    rng, n = np.random.default_rng(2), episodes * rows
    continues = np.arange(1, n + 1) % rows != 0
    action = rng.uniform(-1, 1, (n, 3)).astype(dtype)
    action[~continues] = np.nan  # stands for nothing
    return {"observation": rng.standard_normal((n, 8)).astype(dtype), "action": action,
            "continues": continues}


def refuse_replay(path, arrays, change, part):
    """What `change` has done to arrays is refused, by file and `part`."""
    change(arrays)
    np.savez(path, **arrays)
    refusal(lambda: import_expert.find_replay(path, SIZES), path.name, part)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.float16, np.dtype(">f8")])
def test_a_replay_is_converted_and_distils(tmp_path, dtype, capsys):
    arrays = replay_arrays(dtype=dtype)
    np.savez(tmp_path / "data.npz", **arrays)
    model = write_state(tmp_path / "model.pt", weights())
    command = [str(model), "--task", TASK, "--out", str(tmp_path / "out"), "--replay"]
    assert import_expert.main([*command, str(tmp_path / "data.npz"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert result["episodes"] == 20 and result["transitions"] == 120
    replay = fac.Replay(tmp_path / "out" / "replay.npz")
    assert np.array_equal(replay.observation, arrays["observation"].astype(np.float16))
    kept = arrays["continues"]
    assert np.array_equal(replay.action[kept], arrays["action"][kept].astype(np.float16))
    assert not replay.action[~kept].any()
    assert import_expert.main([*command, str(tmp_path / "out" / "replay.npz"), "--out",
                               str(tmp_path / "again")]) == 0  # its own
    again = fac.Replay(tmp_path / "again" / "replay.npz")
    assert np.array_equal(again.action, replay.action)
    expert, _ = fac.load_model(tmp_path / "out" / "expert.npz")
    distiller = fac.Distiller(expert, again, fac.DistillConfig(steps=2, batch_size=4))
    assert all(np.isfinite(distiller.step()))
    distiller.close()


@pytest.mark.parametrize("change, part", [
    (lambda a: a.pop("action"), "action: not there, only 'observation', 'continues'"),
    (lambda a: a.update(action=a["action"][1:]), "found float64 (139, 3)"),
    (lambda a: a.update(observation=a["observation"][:, :7]), "expected float (140, 8)"),
    (lambda a: a.update(continues=a["continues"] * 1.0), "continues: expected bool"),
    (lambda a: a.update(continues=a["continues"][:-1]), "(139, 8), found float64 (140, 8)"),
    (lambda a: a.update(continues=a["continues"][:, None]), "continues: expected bool (140,)"),
    (lambda a: a.update(continues=a["continues"][:0]), "continues: expected bools, a row or more"),
    (lambda a: a["continues"].__setitem__(-1, True), "continues: row 139, the last: expected"),
    (lambda a: a["observation"].__setitem__((5, 2), 1e39), "tion: row 5, column 2: inf is"),
    (lambda a: a["observation"].__setitem__((7, 0), np.nan), "row 7, column 0: nan is not"),
    (lambda a: a["action"].__setitem__((5, 1), 1.01), "action: row 5, column 1: 1.01 is"),
    (lambda a: a["action"].__setitem__(5, np.nan), "action: row 5, column 0: nan"),
    (lambda a: a.clear(), "observation: not there"),
])
def test_other_replays_are_refused(tmp_path, change, part):
    refuse_replay(tmp_path / "data.npz", replay_arrays(), change, part)


def test_what_is_not_needed_of_a_replay_is_not_read(tmp_path):
    arrays = replay_arrays()
    np.savez(tmp_path / "data.npz", **arrays, episode=np.arange(140) // 7, task=np.array("walk"),
             discount=np.float32(0.99), info=np.array({"a": 1}, object), reward=np.zeros(0))
    found = import_expert.find_replay(tmp_path / "data.npz", SIZES)
    assert np.array_equal(found["continues"], arrays["continues"]) and len(found) == 3


def test_a_replay_keeps_what_float16_would_spoil(tmp_path):
    arrays = replay_arrays()
    arrays["observation"][:, 0] = 1000 + 0.1 * arrays["observation"][:, 0]
    np.savez(tmp_path / "data.npz", **arrays)
    found = import_expert.find_replay(tmp_path / "data.npz", SIZES)
    assert np.array_equal(found["observation"], arrays["observation"].astype(np.float32))
    assert found["action"].dtype == np.float16
    fac.write_npz(tmp_path / "replay.npz", {"kind": "replay"}, found)
    assert fac.Replay(tmp_path / "replay.npz").observation.dtype == np.float32


def d4rl_arrays(rows=140, every=7):
    """With a terminal and a timeout in turn, and a last episode that the file's end cuts off."""
    rng, last = np.random.default_rng(3), np.arange(1, rows + 1) % every == 0
    odd, last[-1] = np.arange(rows) // every % 2 == 1, False
    return {"observations": rng.standard_normal((rows, 8)).astype(np.float32),
            "actions": rng.uniform(-1, 1, (rows, 3)).astype(np.float32), "terminals": last & odd,
            "timeouts": last & ~odd, "rewards": np.zeros(rows, np.float32)}


@pytest.mark.parametrize("suffix, kind, names", [
    (".npz", bool, ("terminals", "timeouts")), (".npz", np.uint8, ("terminals", "timeouts")),
    (".npz", np.float32, ("terminals", "timeouts")), (".npz", np.int64, ("terminals", "timeouts")),
    (".npz", np.int32, ("terminations", "truncations")), (".hdf5", bool, ("terminals", "timeouts")),
    (".h5", np.int64, ("terminals", "truncations"))])
def test_d4rl_s_arrays_are_taken_by_their_names(tmp_path, suffix, kind, names):
    """And Gymnasium's."""
    arrays, path = d4rl_arrays(), tmp_path / f"data{suffix}"
    for key, name in zip(("terminals", "timeouts"), names):
        arrays[name] = arrays.pop(key).astype(kind)
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            for key, value in arrays.items():
                file.create_dataset(key, data=value, compression="gzip")
            file["infos/qpos"], file.attrs["name"] = np.zeros(3), "walker"
    found = import_expert.find_replay(path, SIZES)
    assert np.array_equal(found["continues"], np.arange(1, 141) % 7 != 0)
    assert np.array_equal(found["observation"], arrays["observations"].astype(np.float16))
    kept = found["continues"]
    assert np.array_equal(found["action"][kept], arrays["actions"][kept].astype(np.float16))
    fac.write_npz(tmp_path / "replay.npz", {"kind": "replay"}, found)
    assert len(fac.Replay(tmp_path / "replay.npz").ends) == 20


@pytest.mark.parametrize("change, part", [
    (lambda a: [a.pop("terminals"), a.pop("timeouts")], "expected terminals or timeouts"),
    (lambda a: a.update(timeouts=a["timeouts"][1:]), "equally long"),
    (lambda a: a.update(timeouts=a["timeouts"].astype(object)), "timeouts: expected numbers"),
    (lambda a: a.update(terminals=a["terminals"][:0]), "terminals: expected numbers or bools"),
    (lambda a: a.pop("actions"), "action: not there")])
def test_other_arrays_of_d4rl_are_refused(tmp_path, change, part):
    refuse_replay(tmp_path / "data.npz", d4rl_arrays(), change, part)


def test_minari_episodes_become_a_replay(tmp_path):
    h5py = pytest.importorskip("h5py")
    rng, lengths = np.random.default_rng(0), {0: 9, 2: 4, 10: 6}  # in numbers' order, not names'
    obs = {e: rng.standard_normal((n + 1, 8)).astype(np.float32) for e, n in lengths.items()}
    actions = {e: rng.uniform(-1, 1, (n, 3)).astype(np.float32) for e, n in lengths.items()}
    with h5py.File(tmp_path / "data.hdf5", "w") as file:
        for e in (10, 0, 2):
            file[f"episode_{e}/observations"], file[f"episode_{e}/actions"] = obs[e], actions[e]
            file[f"episode_{e}/infos/qpos"] = np.zeros(3)
    sizes = fac.ModelConfig(dim_obs=8, dim_action=3)
    found = import_expert.find_replay(tmp_path / "data.hdf5", sizes)
    np.testing.assert_array_equal(np.flatnonzero(~found["continues"]), [9, 14, 21])
    np.testing.assert_allclose(found["observation"], np.concatenate([*obs.values()]), atol=2e-3)
    np.testing.assert_allclose(found["action"][10:14], actions[2], atol=1e-3)
    with h5py.File(tmp_path / "data.hdf5", "a") as file:
        del file["episode_2/actions"]
    with pytest.raises(fac.UserError, match=r"data.hdf5: episode_2: .* found \(5, 8\) and \(0,\)"):
        import_expert.find_replay(tmp_path / "data.hdf5", sizes)
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["demos/obs"] = np.zeros(3)
    with pytest.raises(fac.UserError, match="other.h5: expected observation, .* found 'demos'"):
        import_expert.find_replay(tmp_path / "other.h5", sizes)


def test_no_part_of_an_hdf5_file_is_left_out_without_a_word(tmp_path, monkeypatch):
    """Episodes and ends that are links to other files, there or not, and too many bytes."""
    h5py = pytest.importorskip("h5py")
    path, sizes = tmp_path / "main.hdf5", fac.ModelConfig(dim_obs=8, dim_action=3)

    def write(mode="w", count=3, **more):
        with h5py.File(path, mode) as file:
            for e in range(count):
                file[f"episode_{e}/observations"] = np.zeros((6, 8), np.float32)
                file[f"episode_{e}/actions"] = np.zeros((5, 3), np.float32)
            for name, value in more.items():
                file[name] = value

    def refused(*parts):
        refusal(lambda: import_expert.find_replay(path, sizes), path, *parts)

    for link in (h5py.ExternalLink("nowhere.hdf5", "/episode_0"), h5py.SoftLink("/episode_0")):
        write(episode_3=link)
        refused("episode_3: expected in this file, found a link")
    write()
    with h5py.File(path, "a") as file:
        file.attrs["total_episodes"] = np.int64(12)
    refused("expected 12 episodes, its total_episodes, found 3")
    write()
    monkeypatch.setattr(import_expert, "MAX_BYTES", 600)
    refused("episode_2: observations: ", "more than 600 bytes")
    monkeypatch.undo()
    arrays = d4rl_arrays()
    write(count=0, **{**arrays, "timeouts": h5py.ExternalLink("nowhere.hdf5", "/timeouts")})
    refused("timeouts: expected in this file, found a link")


def test_this_project_s_own_file_keeps_what_it_was_made_for(tmp_path):
    """Such as one of other floats, which load_model sends here."""
    state = {key: value.astype(np.float64) for key, value in weights().items()}
    fac.write_npz(tmp_path / "own.npz", {"kind": "expert", "action_repeat": 4, "task": TASK,
                                         "training": {"discount": 0.9, "horizon": 2}}, state)
    flags = [str(tmp_path / "own.npz"), "--task", TASK, "--out"]
    for more, repeat in ([], 4), (["--action-repeat", "2"], 2):
        out = tmp_path / str(repeat)
        assert import_expert.main([*flags, str(out), *more]) == 0
        _, header = fac.load_model(out / "expert.npz")
        assert fac.made_for(header, "x") == {"discount": 0.9, "horizon": 2, "action_repeat": repeat}


def test_others_actions_are_within_the_robot_s_bounds(tmp_path):
    """Pendulum's are -2 to 2; this project's names say that they are scaled already."""
    pytest.importorskip("gymnasium")
    rows, sizes = 24, fac.ModelConfig(dim_obs=3, dim_action=1)
    action, ends = np.linspace(-2, 2, rows)[:, None], np.arange(rows) % 12 == 11
    np.savez(theirs := tmp_path / "theirs.npz", observations=np.zeros((rows, 3)), actions=action,
             timeouts=ends)
    np.savez(own := tmp_path / "own.npz", observation=np.zeros((rows, 3)), action=action / 2,
             continues=~ends)
    for path in theirs, own:
        found = import_expert.find_replay(path, sizes, "gym:Pendulum-v1")["action"]
        np.testing.assert_allclose(found[~ends], action[~ends] / 2, atol=1e-3)
    h5py = pytest.importorskip("h5py")
    with h5py.File(minari := tmp_path / "minari.hdf5", "w") as file:
        file["episode_0/observations"] = np.zeros((rows + 1, 3), np.float32)
        file["episode_0/actions"] = action
    found = import_expert.find_replay(minari, sizes, "gym:Pendulum-v1")["action"]
    np.testing.assert_allclose(found[:-1], action / 2, atol=1e-3)
    np.savez(theirs, observations=np.zeros((rows, 3)), actions=action * 3, timeouts=ends)
    with pytest.raises(fac.UserError, match=r"action: row 0, .*outside \[-1, 1\] \(its bounds\)"):
        import_expert.find_replay(theirs, sizes, "gym:Pendulum-v1")


def packed(h5py, file, name, values, number=32001):
    """An array that says it is packed by one of HDF5's filters, by default Blosc."""
    about = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    about.set_chunk(values.shape)
    about.set_filter(number, h5py.h5z.FLAG_OPTIONAL, ())
    kind, space = h5py.h5t.py_create(values.dtype), h5py.h5s.create_simple(values.shape)
    h5py.h5d.create(file.id, name.encode(), kind, space, about)


def test_an_hdf5_file_holds_its_own_bytes_and_no_more_than_it_has(tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    secret = tmp_path / "secret"
    secret.write_bytes(bytes(8 * 4 * 140))
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["observations"] = np.zeros((140, 8), np.float32)
    makes = {
        "link": ("in this file, found a link", lambda f: f.__setitem__(
            "observations", h5py.ExternalLink("other.h5", "/observations"))),
        "soft": ("in this file, found a link", lambda f: f.__setitem__(
            "observations", h5py.SoftLink("/rewards"))),
        "external": ("or what others hold", lambda f: f.create_dataset(
            "observations", (140, 8), "f4", external=[(str(secret), 0, 8 * 4 * 140)])),
        "large": (f"than {import_expert.MAX_PIECE}", lambda f: f.create_dataset(
            "observations", (1 << 30, 8), "f4", chunks=True)),
        "texts": ("found 'object'", lambda f: f.create_dataset("observations", data=["a"] * 140)),
        "packed": ("packed by HDF5's filter 32001", lambda f: packed(
            h5py, f, "observations", np.zeros((140, 8), np.float32))),
        "group": ("a group of 'goal'", lambda f: f.create_group("observations/goal"))}
    monkeypatch.setattr(import_expert, "MAX_RATIO", 0)
    for name, (part, make) in makes.items():
        with h5py.File(path := tmp_path / f"{name}.h5", "w") as file:
            for key, value in d4rl_arrays().items():
                if key != "observations":
                    file[key] = value
            make(file)
        refusal(lambda path=path: import_expert.find_replay(path, SIZES), path, "observations: ",
                part)
    (tmp_path / "bad.h5").write_bytes(b"\x89HDF\r\n\x1a\nno more")
    refusal(lambda: import_expert.find_replay(tmp_path / "bad.h5", SIZES), "not a readable .h5")


def test_an_action_repeat_goes_with_the_files_through_distill_and_evaluate(tmp_path, capsys,
                                                                           monkeypatch):
    """Episodes, replay, the expert's episodes, evaluation and planner follow it; a replay of
    another is refused, and so is one that doesn't divide."""
    monkeypatch.setattr(fac, "CONTROL_STEPS", 40)  # of 1000
    model, made, played = write_state(tmp_path / "model.pt", weights()), [], []
    environment, play = fac.Environment, fac.play
    monkeypatch.setattr(fac, "Environment", lambda task, *repeat: (
        made.append(repeat), environment(task, *repeat))[1])
    monkeypatch.setattr(fac, "play", lambda *args, **more: (
        played.append(found := play(*args, **more)), found)[1])
    command = [str(model), "--task", TASK, "--collect", "3", "--action-repeat"]
    assert import_expert.main([*command, "3", "--out", str(tmp_path / "no")]) == 2
    assert "action_repeat: expected a divisor" in capsys.readouterr().err
    for repeat in (2, 4):
        out = tmp_path / str(repeat)
        assert import_expert.main([*command, str(repeat), "--out", str(out)]) == 0
        replay = fac.Replay(out / "replay.npz")
        assert replay.transitions == 3 * (40 // repeat - 1)
        assert replay.header["action_repeat"] == repeat
    assert made == [(2,), (4,)]
    distill = ["distill", "--task", TASK, "--expert", str(tmp_path / "4"), "--steps", "4",
               "--expert-episodes", "1", "--episodes", "1", "--plan-samples", "4", "--batch-size",
               "2", "--policy-share", "0", "--plan-iterations", "1", "--held-out", "0.34",
               "--workers", "0", "--out",
               str(tmp_path / "run")]
    assert fac.main([*distill, "--replay", str(tmp_path / "2" / "replay.npz")]) == 2
    assert ("replay.npz: header: action_repeat: expected 4, as the expert was made for, found 2"
            in capsys.readouterr().err)
    made.clear()
    assert fac.main(distill) == 0
    assert fac.main(["evaluate", "--model", str(tmp_path / "run" / "student.npz"), "--workers", "0",
                     "--episodes", "1", "--samples", "4"]) == 0
    assert set(made) == {(), (4,)}  # (): whether there is any
    assert [found[2].shape[1] for found in played] == [20, 10, 10] + [10, 1] * 3 + [10] * 9
    header, _ = fac.read_npz(tmp_path / "run" / "student.npz", ("student",))
    assert fac.made_for(header, "student.npz")["action_repeat"] == 4
    header["action_repeat"] = 7
    refusal(lambda: fac.made_for(header, "student.npz"), "student.npz: header: action_repeat")


def test_collected_episodes_differ_in_start_and_noise_and_end_with_the_robot(monkeypatch, tmp_path):
    class Robot:
        """Its episode is over after 5 decisions, or 7."""
        episode_steps, made = 9, []

        def reset(self, seed):
            self.made.append([seed])
            return np.zeros(8)

        def step(self, action):
            self.made[-1].append(action)
            return np.full(8, len(self.made[-1])), 1.0, len(self.made[-1]) == 6 + len(self.made) % 2

    monkeypatch.setattr(fac, "play", lambda *args, play=fac.play: (
        seen.append(args[-1]), play(*args))[1])
    seen = []
    buffer, returns = import_expert.collect(random_model(1), fac.PlannerConfig(), Robot(), 40, 5)
    assert len({seed for seed, *_ in Robot.made}) == len(Robot.made) == len(buffer) == 40
    assert returns == [6, 5] * 20 and buffer.lengths.tolist() == [5, 4] * 20
    assert seen == [import_expert.MAX_NOISE]
    for begin, n, (_, *actions) in zip(buffer.begins, buffer.lengths, Robot.made):
        assert np.array_equal(buffer.action[begin:begin + n], actions[:n])
        assert buffer.observation[begin:begin + n + 1, 0].tolist() == [0, *range(2, n + 2)]


def test_collected_episodes_distil_and_depend_on_the_seed_alone(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(fac, "CONTROL_STEPS", 40)  # of 1000
    model = write_state(tmp_path / "model.pt", weights())
    for out, seed in (("a", 0), ("b", 0), ("c", 1)):
        assert import_expert.main([str(model), "--task", TASK, "--out", str(tmp_path / out),
                                   "--collect", "3", "--seed", str(seed), "--json"]) == 0
    out, err = capsys.readouterr()
    result = json.loads(out.splitlines()[-1])
    assert result["episodes"] == 3 and result["transitions"] == 57
    assert len(result["returns"]) == 3 and "held" not in err
    a, b, c = (fac.Replay(tmp_path / out / "replay.npz") for out in "abc")
    assert np.array_equal(a.observation, b.observation) and np.array_equal(a.action, b.action)
    assert not np.array_equal(a.action, c.action)
    assert a.header["task"] == TASK and np.array_equal(a.ends, [19, 39, 59])
    a.starts(2, 0.33)

    before = {path: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    for flags, part in (([str(tmp_path / "a" / "expert.npz")], "expert.npz: would be replaced"),
                        ([str(model), "--replay", str(tmp_path / "a" / "replay.npz")],
                         "replay.npz: would be replaced"),
                        ([str(model)], "replay.npz: is there from before; pass --replay or --"),
                        ([str(model), "--task", "reacher-hard", "--collect", "3"],
                         "expert.npz: another expert"),
                        ([str(fac.data_file("reacher-easy", "expert.npz")), "--collect", "3"],
                         "expert.npz: another expert")):
        assert import_expert.main(["--task", TASK, *flags, "--out", str(tmp_path / "a")]) == 2
        assert part in capsys.readouterr().err
    (tmp_path / "d").mkdir()
    shutil.copy(tmp_path / "a" / "replay.npz", tmp_path / "d")
    assert import_expert.main([str(model), "--task", TASK, "--out", str(tmp_path / "d"),
                               "--collect", "3"]) == 2
    assert "replay.npz: another expert's" in capsys.readouterr().err

    def interrupt(*_):
        raise KeyboardInterrupt
    monkeypatch.setattr(import_expert, "collect", interrupt)  # the old pair stays
    assert import_expert.main([str(model), "--task", TASK, "--out", str(tmp_path / "a"),
                               "--collect", "3", "--seed", "1"]) == 130
    assert {path: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before
