"""Files: weights, replays, and `from_dict`, which reads their headers."""
import errno
import json
import os
import zipfile

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import fac_tdmpc_ref as fac
from export_golden import digest
from numpy_learner import ExpertConfig
from toys import refusal, replay_arrays, write_replay

F32 = np.float32


def make_model(num_agents=1, policy=False, expert_latent_dim=0, prior_steps=0):
    """A small model of 6 actions with no weight left at its initial zero or one."""
    config = fac.ModelConfig(dim_obs=7, dim_action=6, num_agents=num_agents, latent_dim=5,
                             enc_dim=9, mlp_dim=11, expert_latent_dim=expert_latent_dim,
                             expert_enc_dim=8, prior_steps=prior_steps)
    rng = np.random.default_rng(0)
    model = fac.WorldModel.create(config, rng, policy)
    for value in model.params.values():
        value[:] = rng.standard_normal(value.shape, F32)
    return model


def contents(path):
    """(header, arrays) of a file, read without the code under test."""
    with np.load(path) as file:
        arrays = {k: file[k] for k in file.files}
    return json.loads(arrays.pop("header").tobytes()), arrays


def write_raw(path, header, arrays):
    """Like write_npz, but takes any header and leaves nothing out or in."""
    if header is not None:
        text = header if isinstance(header, bytes) else json.dumps(header).encode()
        arrays = {**arrays, "header": np.frombuffer(text, np.uint8)}
    np.savez(path, **arrays)
    return path


@pytest.fixture
def expert_file(tmp_path):
    path = tmp_path / "expert.npz"
    fac.save_model(path, make_model(policy=True), {"kind": "expert", "task": "t"})
    return path


# models: round trip -------------------------------------------------------------------


@pytest.mark.parametrize("num_agents, policy, expert_latent_dim, prior_steps", [
    (1, True, 0, 0), *((n, False, width, L) for n in (1, 2, 3) for width in (0, 13) for L in (0, 4))
])
def test_a_model_comes_back_bit_for_bit(tmp_path, num_agents, policy, expert_latent_dim,
                                        prior_steps):
    model = make_model(num_agents, policy, expert_latent_dim, prior_steps)
    path = tmp_path / "model.npz"
    fac.save_model(path, model, {"kind": "student", "task": "fish-swim", "extra": [1, {"a": 2.5}]})
    found, header = fac.load_model(path)
    assert found.config == model.config and found.has_policy == policy
    assert list(found.params) == list(model.params)
    for key, value in model.params.items():
        assert found.params[key].dtype == F32 and found.params[key].flags.c_contiguous
        assert found.params[key].shape == value.shape and np.array_equal(found.params[key], value)
    assert (header["task"], header["extra"]) == ("fish-swim", [1, {"a": 2.5}])
    obs = np.ones((7, 2), F32)
    assert np.array_equal(found.encode(obs), model.encode(obs))
    assert np.array_equal(found.latents(obs), model.latents(obs))
    assert [*{key.split(".")[0] for key in model.params if key.startswith("_expert")}] == [
        "_expert_encoder"] * (expert_latent_dim > 0)  # neither its policy nor its dynamics


def test_an_expert_is_stored_with_the_shapes_of_torch(expert_file):
    _, arrays = contents(expert_file)
    shapes = {key: value.shape for key, value in arrays.items()}
    assert shapes["_encoder.0.weight"] == (9, 7) and shapes["_encoder.0.bias"] == (9,)
    assert shapes["_Q1.1.weight"] == shapes["_Q1.1.bias"] == (11,)    # LayerNorm
    assert shapes["_pi.4.weight"] == (6, 11) and shapes["_dynamics.0.weight"] == (11, 5 + 6)


def test_agents_are_stored_with_a_leading_axis(tmp_path):
    fac.save_model(tmp_path / "m.npz", make_model(3), {"kind": "student"})
    _, arrays = contents(tmp_path / "m.npz")
    assert arrays["_encoder.2.weight"].shape == (15, 9)     # central: no axis
    assert arrays["_Q2.0.weight"].shape == (3, 11, 5 + 2)
    assert arrays["_Q2.1.weight"].shape == arrays["_Q2.0.bias"].shape == (3, 11)


def test_weights_without_their_axes_are_not_saved(tmp_path):
    model = make_model()
    model.params["_Q1.0.bias"] = model.params["_Q1.0.bias"][..., 0]
    with pytest.raises(fac.UserError, match=r"_Q1.0.bias: expected \(N, rows, columns\), found"):
        fac.save_model(tmp_path / "m.npz", model, {"kind": "expert"})
    model = make_model()
    model.params["_Q1.0.bias"][0, 1] = np.nan
    refusal(lambda: fac.save_model(tmp_path / "m.npz", model, {}), "npz: _Q1.0.bias", "not finite")
    assert not list(tmp_path.iterdir())


def test_a_policy_of_several_agents_is_unknown(tmp_path):
    model = make_model(3)
    model.params["_pi.0.weight"] = model.params["_dynamics.0.weight"]
    fac.save_model(path := tmp_path / "m.npz", model, {"kind": "student"})
    refusal(lambda: fac.load_model(path), path, "_pi.0.weight", "unknown entry", "of one agent")


# read_npz -----------------------------------------------------------------------------


def test_missing_file(tmp_path):
    refusal(lambda: fac.load_model(tmp_path / "none.npz"), tmp_path / "none.npz", "no such file")
    refusal(lambda: fac.Replay(tmp_path / "none.npz"), tmp_path / "none.npz", "no such file")


@pytest.mark.parametrize("content", [b"", b"weights", b"PK\x03\x04", b"\x80\x04N.", b"\x93NUMPY"])
def test_a_file_that_is_no_npz(tmp_path, content):
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    refusal(lambda: fac.load_model(path), path, "not a readable .npz file")


def test_a_folder_is_no_npz(tmp_path):
    refusal(lambda: fac.load_model(tmp_path), tmp_path, "not a readable .npz file")
    np.savez(tmp_path / "d4rl.npz", observations=np.zeros((2, 3)))
    refusal(lambda: fac.Replay(tmp_path / "d4rl.npz"), "header", "data/import_expert.py")
    (tmp_path / "d4rl.hdf5").write_bytes(b"\x89HDF\r\n\x1a\n")
    refusal(lambda: fac.Replay(tmp_path / "d4rl.hdf5"), "d4rl.hdf5", "data/import_expert.py")


def test_a_single_array_is_no_npz(tmp_path):
    np.save(tmp_path / "model.npy", np.zeros(3))
    refusal(lambda: fac.load_model(tmp_path / "model.npy"), tmp_path / "model.npy")


def test_an_entry_that_is_no_array(tmp_path, expert_file):
    """An .npz may hold any file; NumPy hands such entries out as bytes."""
    with zipfile.ZipFile(tmp_path / "header.npz", "w") as file:
        file.writestr("header", "{}")
    refusal(lambda: fac.load_model(tmp_path / "header.npz"), tmp_path / "header.npz", "header")
    with zipfile.ZipFile(expert_file, "a") as file:
        file.writestr("notes.txt", "hello")
    refusal(lambda: fac.load_model(expert_file), expert_file, "notes.txt", "unknown entry")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_truncated_file(expert_file, share):
    data = expert_file.read_bytes()
    expert_file.write_bytes(data[:int(share * len(data))])
    refusal(lambda: fac.load_model(expert_file), expert_file, "not a readable .npz file")


def test_damage_anywhere_is_refused_in_one_line(tmp_path, expert_file):
    """Bytes overwritten at random: either the file still loads, or a UserError names it."""
    rng, refused = np.random.default_rng(0), 0
    replay = write_replay(tmp_path / "replay.npz")
    for path, load in ((expert_file, fac.load_model), (replay, fac.Replay)):
        data, damaged = path.read_bytes(), tmp_path / "damaged.npz"
        for _ in range(150):
            changed = bytearray(data)
            changed[rng.integers(len(data))] ^= int(rng.integers(1, 256))
            damaged.write_bytes(changed)
            try:
                load(damaged)
            except fac.UserError as error:
                assert str(damaged) in str(error) and "\n" not in str(error)
                refused += 1
    assert refused > 150


@pytest.mark.parametrize("old, new", [
    (b"(9, 7)", b"(9, 7 "),             # Python's tokenizer gives up
    (b"(9, 7)", b"(9, -)"), (b"'<f4'", b"'<q4'"),
    (b"\x93NUMPY\x01\x00v\x00", b"\x93NUMPY\x01\x00\xff\xff")])  # NumPy's answer has two lines
def test_damaged_description_of_an_array(tmp_path, expert_file, old, new):
    path = tmp_path / "damaged.npz"
    with zipfile.ZipFile(expert_file) as source, zipfile.ZipFile(path, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "_encoder.0.weight.npy":
                assert old in data
                data = data.replace(old, new, 1) + bytes(70_000)
            target.writestr(name, data)
    refusal(lambda: fac.load_model(path), path, "not a readable .npz file")


def test_pickles_are_refused(tmp_path, expert_file):
    header, arrays = contents(expert_file)
    path = tmp_path / "evil.npz"

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "ran"),)

    arrays["_Q1.0.bias"] = np.array([Evil()], object)
    write_raw(path, header, arrays)
    refusal(lambda: fac.load_model(path), path, "allow_pickle")
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("header", [None, b"{", b"\xff\xfe", [1, 2], b"null", "text"])
def test_header_missing_or_no_json_object(tmp_path, expert_file, header):
    _, arrays = contents(expert_file)
    path = write_raw(tmp_path / "m.npz", header, arrays)
    refusal(lambda: fac.load_model(path), path, "header")


@pytest.mark.parametrize("changes, parts", [
    ({"format": "fac-tdmpc-ref 0"}, ("header: format", repr(fac.FORMAT), "'fac-tdmpc-ref 0'")),
    ({"format": "fac-tdmpc-ref 2"}, ("'fac-tdmpc-ref 2'",)),
    ({"format": None}, ("header: format", repr(fac.FORMAT), "None")),
    ({"kind": "replay"}, ("header: kind", "expert or student", "'replay'")),
    ({"kind": None}, ("header: kind", "expert or student", "None")),
    ({"model": None}, ("header: model",)),
    ({"model": [3]}, ("header: model",)),
])
def test_wrong_header(tmp_path, expert_file, changes, parts):
    header, arrays = contents(expert_file)
    path = write_raw(tmp_path / "m.npz", {**header, **changes}, arrays)
    refusal(lambda: fac.load_model(path), path, *parts)


@pytest.mark.parametrize("changes, parts", [
    ({"width": 3}, ("'width'",)),
    ({"num_agents": "3"}, ("num_agents", "int", "'3'")),
    ({"latent_dim": 5.5}, ("latent_dim", "int", "5.5")),
    ({"num_agents": 4}, ("num_agents must be one of [1, 2, 3, 6]", "not 4")),
])
def test_wrong_model_settings_name_the_file(tmp_path, expert_file, changes, parts):
    header, arrays = contents(expert_file)
    header["model"].update(changes)
    path = write_raw(tmp_path / "m.npz", header, arrays)
    refusal(lambda: fac.load_model(path), path, "header: model", *parts)


def test_earlier_models_that_said_they_hold_no_expert_s_policy_load(tmp_path):
    for kind in ("student", "expert"):
        model = make_model(3) if kind == "student" else make_model(1, True)
        fac.save_model(tmp_path / "m.npz", model, {"kind": kind})
        header, arrays = contents(tmp_path / "m.npz")
        assert "expert_mlp_dim" not in header["model"]
        header["model"]["expert_mlp_dim"] = 0
        found, read = fac.load_model(write_raw(tmp_path / "m.npz", header, arrays))
        assert found.config == model.config and "expert_mlp_dim" not in read["model"]


@pytest.mark.parametrize("key", ["_prior.4.bias", "_prior_encoder.0.weight"])
def test_a_student_s_file_without_its_priors_is_refused(tmp_path, key):
    fac.save_model(tmp_path / "m.npz", make_model(3, False, 13, 4), {"kind": "student"})
    header, arrays = contents(tmp_path / "m.npz")
    del arrays[key]
    path = write_raw(tmp_path / "m.npz", header, arrays)
    refusal(lambda: fac.load_model(path), path, key, "found object (0,)")
    header["model"]["prior_steps"] = 0  # or with ones that it doesn't tell of
    path = write_raw(tmp_path / "m.npz", header, arrays)
    refusal(lambda: fac.load_model(path), path, "_prior", "unknown entry")


# load_model ---------------------------------------------------------------------------


def changed_model(expert_file, key, change):
    """The expert file with one entry replaced by change(entry), or dropped where that is None."""
    header, arrays = contents(expert_file)
    value = change(arrays.pop(key))
    return write_raw(expert_file.parent / "changed.npz", header,
                     {**arrays, **({} if value is None else {key: value})})


KEYS = ("_encoder.2.weight", "_dynamics.4.bias", "_Q1.1.weight", "_pi.2.bias")


@pytest.mark.parametrize("key", KEYS)
def test_missing_weights(expert_file, key):
    path = changed_model(expert_file, key, lambda v: None)
    refusal(lambda: fac.load_model(path), path, key, "found object (0,)", "float32")


def test_a_policy_without_its_first_layer_is_unknown(expert_file):
    """That layer tells whether there is a policy: without it the rest is left over."""
    path = changed_model(expert_file, "_pi.0.weight", lambda v: None)
    refusal(lambda: fac.load_model(path), path, "_pi.0.bias", "unknown entry")


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("change", [lambda v: v[1:], lambda v: v[None], lambda v: v[..., None]])
def test_weights_of_a_wrong_shape(expert_file, key, change):
    shape = contents(expert_file)[1][key].shape
    path = changed_model(expert_file, key, change)
    found = contents(path)[1][key].shape
    refusal(lambda: fac.load_model(path), path, key, f"expected float32 {shape}", f"{found}")


def test_compressed_weights_are_float16_and_come_back_as_what_they_say(expert_file):
    model, header = fac.load_model(expert_file)
    fac.save_model(path := expert_file.parent / "half.npz", model, header, compress=True)
    assert {v.dtype for v in contents(path)[1].values()} == {np.dtype(np.float16)}
    half, again = fac.load_model(path)
    assert again == header
    for key, value in half.params.items():
        assert value.dtype == F32
        np.testing.assert_array_equal(value, model.params[key].astype(np.float16))
    model.params["_Q1.3.bias"][0, 0] = 1e6  # infinite as float16
    with np.errstate(over="ignore"):
        refusal(lambda: fac.save_model(path, model, header, True), "half.npz: _Q1.3.bias", "finite")


@pytest.mark.parametrize("dtype", ["float64", "int32"])
def test_weights_of_a_wrong_dtype(expert_file, dtype):
    path = changed_model(expert_file, "_Q2.3.weight", lambda v: v.astype(dtype))
    refusal(lambda: fac.load_model(path), path, "_Q2.3.weight", "expected float32",
            f"found {dtype}")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_weights_that_are_not_finite(expert_file, bad):
    def spoil(value):
        value[-1] = bad
        return value

    path = changed_model(expert_file, "_reward.2.bias", spoil)
    refusal(lambda: fac.load_model(path), path, "_reward.2.bias", "not finite")


def test_unknown_entry(expert_file):
    header, arrays = contents(expert_file)
    path = write_raw(expert_file.parent / "m.npz", header, {**arrays, "_Q3.0.weight": np.ones(2)})
    refusal(lambda: fac.load_model(path), path, "_Q3.0.weight", "unknown entry")


def test_sizes_in_the_header_must_be_those_of_the_weights(expert_file):
    header, arrays = contents(expert_file)
    header["model"]["mlp_dim"] = 12
    path = write_raw(expert_file.parent / "m.npz", header, arrays)
    refusal(lambda: fac.load_model(path), path, "_dynamics.0.weight", "(12, 11)", "(11, 11)")


# from_dict ----------------------------------------------------------------------------


@pytest.mark.parametrize("config", [
    fac.PlannerConfig(samples=40, min_std=0.1, output="mean"),
    fac.DistillConfig(steps=3, kl="reverse"),
    fac.ModelConfig(8, 3, 3, expert_latent_dim=6), ExpertConfig(lr=1e-3)])
def test_a_config_survives_json(config):
    values = json.loads(json.dumps(vars(config)))
    assert fac.from_dict(type(config), values, "x") == config


def test_whole_numbers_will_do_for_decimal_ones():
    assert fac.from_dict(fac.PlannerConfig, {"max_std": 1}, "x").max_std == 1


@pytest.mark.parametrize("values, parts", [
    ({"sample": 3}, ("'sample'",)),
    ({"samples": "3"}, ("samples", "'3'")),
    ({"samples": None}, ("samples", "None")),
    ({"samples": 4, "elites": 5}, ("elites must be at most samples (4), not 5",)),
    ({"output": "best"}, ("output", "'sampled', 'mean'", "'best'")),
])
def test_settings_that_are_refused(values, parts):
    refusal(lambda: fac.from_dict(fac.PlannerConfig, values, "some file"), "some file", *parts)


# replay -------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["observation", "action", "continues"])
def test_replay_without_an_array(tmp_path, key):
    path = write_replay(tmp_path / "r.npz", **{key: None})
    refusal(lambda: fac.Replay(path), path, key, "expected", "found nothing")


@pytest.mark.parametrize("key, value", [
    ("observation", np.zeros(180, np.float16)), ("observation", np.float16(1)),
    ("action", np.zeros((179, 3), np.float16)), ("action", np.zeros((180, 3, 1), np.float16)),
    ("continues", np.ones((180, 1), bool)), ("continues", np.zeros(181, bool))])
def test_replay_with_a_wrong_shape(tmp_path, key, value):
    path = write_replay(tmp_path / "r.npz", **{key: value})
    refusal(lambda: fac.Replay(path), path, "expected", "found", *(
        [] if key == "observation" else [f"{key}:", value.shape]))


@pytest.mark.parametrize("key, dtype", [
    ("observation", "float64"), ("observation", "<U1"), ("action", "int8"),
    ("continues", "float16"), ("continues", "<U1")])
def test_replay_with_a_wrong_dtype(tmp_path, key, dtype):
    value = replay_arrays()[key].astype(dtype)
    path = write_replay(tmp_path / "r.npz", **{key: value})
    refusal(lambda: fac.Replay(path), path, f"{key}:", dtype,
            "bool" if key == "continues" else "float16")


@pytest.mark.parametrize("key", ["observation", "action"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_replay_that_is_not_finite(tmp_path, key, bad):
    value = replay_arrays()[key]
    value[100, 1] = bad
    path = write_replay(tmp_path / "r.npz", **{key: value})
    refusal(lambda: fac.Replay(path), path, f"{key}: row 100, column 1: {bad} is not finite")


def test_replay_whose_actions_are_out_of_range(tmp_path):
    value = replay_arrays()["action"]
    value[100, 1] = -1.01
    path = write_replay(tmp_path / "r.npz", action=value)
    refusal(lambda: fac.Replay(path), path, "action: row 100, column 1: -1.00",
            "outside [-1, 1]")


@pytest.mark.parametrize("continues", [np.ones(180, bool), np.arange(180) % 30 != 0])
def test_replay_must_end_with_an_episode(tmp_path, continues):
    path = write_replay(tmp_path / "r.npz", continues=continues)
    refusal(lambda: fac.Replay(path), path, "continues:", "expected False in the last row")


def test_empty_replay(tmp_path):
    path = write_replay(tmp_path / "r.npz", **{k: v[:0] for k, v in replay_arrays().items()})
    refusal(lambda: fac.Replay(path), path, "continues:")


def test_a_model_is_no_replay(expert_file):
    refusal(lambda: fac.Replay(expert_file), expert_file, "header: kind", "'expert'", "replay")


def test_what_a_replay_holds(tmp_path):
    replay = fac.Replay(write_replay(tmp_path / "r.npz"))
    assert (replay.dim_obs, replay.dim_action, replay.transitions) == (8, 3, 6 * 29)
    assert replay.ends.tolist() == [29, 59, 89, 119, 149, 179]


@settings(max_examples=60, deadline=None)
@example(lengths=[5, 5, 5, 5], steps=2, held_out=0.9)  # at least every second one is trained on
@given(lengths=st.lists(st.integers(1, 9), min_size=1, max_size=12), steps=st.integers(1, 5),
       held_out=st.sampled_from([0.01, 0.05, 0.2, 0.3, 0.5, 0.9]))
def test_starts_stay_in_their_episode_and_no_episode_serves_both(lengths, steps, held_out):
    """Compared with a plain loop. An episode of length l has l rows, l - 1 of them with actions.
    Where no share so small can be held out, a larger one is, up to a half."""
    replay = fac.Replay.__new__(fac.Replay)  # no file: only the rows' lengths matter
    replay.path, replay.ends = "replay", np.cumsum(lengths) - 1
    episode = np.repeat(np.arange(len(lengths)), lengths)
    one, every = len(lengths) == 1, max(2, round(1 / held_out))
    if one:  # its end is held out, as if it were another
        cut = max(0, lengths[0] - 1 - max(steps, round(held_out * (lengths[0] - 1))))
        episode = np.arange(lengths[0]) > cut
    possible = [row for row in range(len(episode))
                if row + steps < len(episode) and (one or episode[row] == episode[row + steps])]
    if one:
        expected = [[row for row in possible if row + steps <= cut],
                    [row for row in possible if row >= cut]]
    for k in [] if one else range(every, 1, -1):
        expected = [[row for row in possible if (episode[row] % k == k - 1) == held]
                    for held in (False, True)]
        if all(expected):
            break
    if not all(expected):
        refusal(lambda: replay.starts(steps, held_out), "replay", f"at least {steps} actions")
        return
    found = replay.starts(steps, held_out)
    assert [rows.tolist() for rows in found] == expected
    assert one or not set(episode[found[0]]) & set(episode[found[1]])
    assert not one or found[0].max() + steps <= found[1].min()


def test_one_long_episode_is_held_out_by_time(tmp_path):
    """A robot's log, D4RL's maze2d: of 179 actions the last tenth, no less than a sequence."""
    path = write_replay(tmp_path / "r.npz", continues=np.arange(180) < 179)
    kept, held = fac.Replay(path).starts(4, 0.1, seed=7)
    assert (kept == np.arange(161 - 4 + 1)).all() and (held == np.arange(161, 176)).all()
    kept, held = fac.Replay(path).starts(80, 0.1)
    assert kept[-1] == 19 and held.tolist() == [99]
    refusal(lambda: fac.Replay(path).starts(90, 0.1), path, "or one of 180")


def test_a_replay_in_float32_is_taken_as_it_is(tmp_path):
    arrays = replay_arrays()
    seen = 1000 + np.float32(0.1) * arrays["observation"]
    replay = fac.Replay(write_replay(tmp_path / "r.npz", observation=seen))
    assert np.array_equal(replay.sequences(np.arange(9), 1)[0].T, seen[:9])
    replay = fac.Replay(write_replay(tmp_path / "r.npz", action=arrays["action"].astype(F32)))
    assert replay.action.dtype == F32


@pytest.mark.parametrize("offset, scale, dtype", [
    (0, 1, np.float16), (1, 0.1, np.float16), (1000, 0.1, F32), (0, 1e-9, F32), (0, 1e-30, F32),
    (0, 1e5, F32), (1e5, 0, F32), (1000.3, 0, np.float16)])
def test_what_float16_would_spoil_stays_float32(offset, scale, dtype):
    """By a hundredth of a feature's deviation; a constant has nothing to lose but its size."""
    rows = np.random.default_rng(0).standard_normal((500, 3)).astype(F32)
    rows[:, 1] = offset + scale * rows[:, 1].astype(float)
    kept = fac.compact(rows)
    assert kept.dtype == dtype
    if scale and dtype == F32:
        assert np.array_equal(kept, rows)
    elif scale:
        assert ((kept - rows).std(0) < 0.01 * rows.std(0)).all()


def test_a_weight_of_another_type_is_not_said_to_be_of_another_size(tmp_path, expert_file):
    header, arrays = fac.read_npz(expert_file, ("expert",))
    arrays["_Q1.3.bias"] = arrays["_Q1.3.bias"].astype(float)
    fac.write_npz(tmp_path / "x.npz", header, arrays)
    refusal(lambda: fac.load_model(tmp_path / "x.npz"), "_Q1.3.bias: expected float32 (",
            "found float64 (")


def test_the_share_that_is_held_out(tmp_path):
    """6 episodes of 29 actions: every third held out, 26 starts of 4 steps in each."""
    kept, held = fac.Replay(write_replay(tmp_path / "r.npz")).starts(4, 1 / 3)
    assert set(held // 30) == {2, 5} and set(kept // 30) == {0, 1, 3, 4}
    assert (len(kept), len(held)) == (4 * 26, 2 * 26)
    assert max(kept % 30) == max(held % 30) == 25


def test_sequences(tmp_path):
    replay, arrays = fac.Replay(write_replay(tmp_path / "r.npz")), replay_arrays()
    starts = np.array([3, 60, 3, 170, 0])
    obs, actions = replay.sequences(starts, 4)
    assert obs.shape == (8, 5) and actions.shape == (4, 3, 5)
    assert obs.dtype == actions.dtype == F32
    for b, start in enumerate(starts):
        np.testing.assert_array_equal(obs[:, b], arrays["observation"][start])
        for h in range(4):
            np.testing.assert_array_equal(actions[h, :, b], arrays["action"][start + h])


def test_checksums_tell_replays_apart_by_every_array(tmp_path):
    found, arrays = set(), replay_arrays()
    later = arrays["continues"].copy()
    later[9] = False  # one more end
    for changes in ({}, {"observation": arrays["observation"][::-1]}, {"continues": later},
                    {"action": arrays["action"][::-1]}):
        replay = fac.Replay(write_replay(tmp_path / "r.npz", **changes))
        found.add(tuple(fac.data_checksums(make_model(), replay)))
    assert len(found) == 4
    other = make_model()
    other.params["_Q2.5.bias"] += 1
    assert fac.data_checksums(other, replay)[0] != fac.data_checksums(make_model(), replay)[0]


def test_a_student_s_file_plans_over_what_it_was_distilled_for():
    """Its expert's discount, and its own horizon before its expert's."""
    header = {"training": {"discount": 0.9, "horizon": 3, "lr": 1}, "distill": {"horizon": 1}}
    assert fac.made_for(header, "x") == {"discount": 0.9, "horizon": 1}
    assert fac.made_for({**header, "distill": None}, "x") == {"discount": 0.9, "horizon": 3}
    assert fac.made_for({}, "x") == {}
    own = {"samples": 7, "horizon": 5, "discount": 0.8}
    assert fac.made_for({**header, "planner": {**own, "speed": "plain"}}, "x") == own


# data_file ----------------------------------------------------------------------------


def test_data_file(tmp_path, monkeypatch):
    monkeypatch.setattr(fac, "EXPERTS", tmp_path)
    refusal(lambda: fac.data_file("fish-swim", "expert.npz"),
            tmp_path / "fish-swim" / "expert.npz", "train_expert.py --task fish-swim", "--expert",
            "--replay")
    (tmp_path / "walker-walk").mkdir()
    (tmp_path / "walker-walk" / "expert.npz").touch()
    found = fac.data_file("walker-walk", "expert.npz")
    assert found == tmp_path / "walker-walk" / "expert.npz"
    refusal(lambda: fac.data_file("walker-walk", "replay.npz"), "walker-walk/replay.npz")
    refusal(lambda: fac.data_file("walker-wolk", "expert.npz"), "did you mean 'walker-walk'")


# atomic_file --------------------------------------------------------------------------


@pytest.fixture
def old_file(tmp_path):
    path = tmp_path / "out" / "file.npz"
    path.parent.mkdir()
    path.write_bytes(b"old")
    return path


def untouched(path):
    return path.read_bytes() == b"old" and os.listdir(path.parent) == [path.name]


def test_a_file_appears_complete_and_readable_by_all(tmp_path):
    path = tmp_path / "new" / "folder" / "file.bin"
    with fac.atomic_file(path) as file:
        file.write(b"half")
        assert not path.exists()
        file.write(b"whole")
    assert path.read_bytes() == b"halfwhole" and os.listdir(path.parent) == ["file.bin"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("mask", [0o077, 0o002])
def test_files_follow_the_umask(tmp_path, mask):
    before = os.umask(mask)
    try:
        fac.write_json(tmp_path / "x.json", {})
    finally:
        os.umask(before)
    assert (tmp_path / "x.json").stat().st_mode & 0o777 == 0o666 & ~mask


def test_the_old_file_is_there_until_the_new_one_is(old_file):
    with fac.atomic_file(old_file, "w", newline="") as file:
        file.write("new\n")
        file.flush()
        assert old_file.read_bytes() == b"old"
    assert old_file.read_bytes() == b"new\n" and os.listdir(old_file.parent) == ["file.npz"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_writer_that_fails_changes_nothing(old_file, error):
    with pytest.raises(error), fac.atomic_file(old_file) as file:
        file.write(b"half a fi")
        raise error
    assert untouched(old_file)


@pytest.mark.parametrize("name", ["open", "replace"])
def test_a_folder_that_can_not_be_written(old_file, monkeypatch, name):
    """Read-only, as the system would say it: permissions don't bind the superuser."""
    def refused(*_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(fac if name == "open" else fac.os, name, refused, raising=False)
    refusal(lambda: fac.write_npz(old_file, {}, {}), old_file, "can't be written",
            "Permission denied")
    assert untouched(old_file)


@pytest.mark.parametrize("inside", ["file.npz/new.npz", "file.npz/folder/new.npz"])
def test_a_folder_that_is_a_file(old_file, inside):
    path = old_file.parent / inside
    refusal(lambda: fac.write_npz(path, {}, {}), path, "can't be written")
    assert untouched(old_file)


def test_a_path_that_is_a_folder(tmp_path):
    (tmp_path / "model.npz").mkdir()
    refusal(lambda: fac.write_npz(tmp_path / "model.npz", {}, {}), "model.npz", "can't be written")
    assert os.listdir(tmp_path) == ["model.npz"]


# digest -------------------------------------------------------------------------------


def test_digest_keeps_norm_product_and_entries():
    array = np.random.default_rng(0).standard_normal((6, 50)).astype(F32)
    found = digest(array)
    flat = array.astype(np.float64).ravel()
    assert found.shape == (66,) and found.dtype == np.float64
    np.testing.assert_allclose(found[0] ** 2, sum(v * v for v in flat), rtol=1e-12)
    fixed = [np.cos(i * i % 1009) for i in range(300)]
    product = sum(f * v for f, v in zip(fixed, flat)) / sum(f * f for f in fixed) ** 0.5
    np.testing.assert_allclose(found[1], product, rtol=1e-9)
    assert found[2] == flat[0] and found[-1] == flat[-1] and np.isin(found[2:], flat).all()


@pytest.mark.parametrize("change", [
    lambda a: a * F32(1.001), lambda a: a[::-1], lambda a: np.roll(a, 1), lambda a: -a])
def test_digest_tells_arrays_apart(change):
    """Scaled, reordered or negated arrays have other digests, which is what they are for."""
    array = np.random.default_rng(0).standard_normal(5000).astype(F32)
    assert not np.allclose(digest(array), digest(change(array)), rtol=1e-4)
    assert np.array_equal(digest(array), digest(array.reshape(50, 100)))
