"""data/tour.py: the numbers behind its pictures, against plain computations, and its page."""
import json
import re
from collections import defaultdict

import numpy as np
import pytest

import fac_tdmpc_ref as fac
import tour
from speed import multiply_adds
from toys import random_model

STATES, PAGE = 32, fac.DATA / "tour.md"
CONFIG = fac.dataclasses.replace(tour.CONFIG, steps=3, batch_size=8, noise_samples=4, warmup=1)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A tiny expert, and a replay of 40 random episodes."""
    rng, path = np.random.default_rng(0), tmp_path_factory.mktemp("tour") / "replay.npz"
    fac.write_npz(path, {"kind": "replay"}, {
        "observation": rng.standard_normal((400, 8), np.float32),
        "action": rng.uniform(-1, 1, (400, 3)).astype(np.float32),
        "continues": np.arange(400) % 10 < 9})
    return random_model(1, policy=True), fac.Replay(path)


@pytest.fixture(scope="module")
def scene(data):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tour, "SIZES", {"mlp_dim": 8, "latent_dim": 4})
        return tour.make_scene(*data, CONFIG, 0, STATES)


def by_hand(values, temperature=0.5):
    e = np.exp(values.astype(float) / temperature)
    return e / e.sum(-1, keepdims=True)


def predicted(scene, model):
    """Global rewards and both Q of all trajectories, three (L, B, K)."""
    return fac.predict(model, model.encode(scene.obs), scene.actions)


def test_the_scene_s_trajectories_are_held_out_and_copy_0_is_the_recorded_one(scene, data):
    _, replay = data
    _, held_out = replay.starts(4, CONFIG.held_out, scene.seed)
    known = {tuple(replay.observation[row]): replay.action[row:row + 4] for row in held_out}
    for b in range(STATES):
        np.testing.assert_array_equal(scene.actions[:, :, b, 0], known[tuple(scene.obs[:, b])])
    assert np.abs(scene.actions).max() <= 1 and scene.actions.shape == (4, 3, STATES, 4)


def test_drawn_is_the_trajectory_nearest_to_the_means(scene):
    D = np.concatenate([tour.divergence(scene, model) for model in (scene.fresh, scene.student)])
    away = [sum(abs(D[i, h, b] / D[i, h].mean() - 1) for i in range(4) for h in range(4))
            for b in range(STATES)]
    assert scene.shown == np.argmin(away)


def test_layers_are_one_matrix_with_a_block_for_each_agent(scene):
    found, (N, rows, columns) = tour.numbers_layers(scene), (3, 8, 5)
    x = np.random.default_rng(0).standard_normal((N, columns, 2), np.float32)
    W = scene.student.params["_dynamics.0.weight"]
    np.testing.assert_allclose(found["student"] @ x.reshape(-1, 2),
                               fac.linear(x, W, np.float32(0)).reshape(-1, 2), rtol=1e-5, atol=1e-6)
    assert np.count_nonzero(found["student"]) <= N * rows * columns
    np.testing.assert_array_equal(found["expert"], scene.expert.params["_dynamics.0.weight"][0])
    for key in ("expert", "student"):
        params = {k: v for k, v in getattr(scene, key).params.items() if "_pi" not in k}
        assert sum(found[f"{key} weights"]) == sum(v.size for v in params.values())


def test_softmax_is_of_the_expert_s_first_q(scene):
    found, b = tour.numbers_copies(scene), scene.shown
    np.testing.assert_array_equal(found["actions"], scene.actions[:, :, b])
    q = predicted(scene, scene.expert)[1][:, b]
    np.testing.assert_allclose(found["q"], q, rtol=1e-5)
    np.testing.assert_allclose(found["p"], by_hand(q), rtol=1e-4)


def test_divergences_are_those_of_the_loss(scene):
    found, expert = tour.numbers_softmax(scene), predicted(scene, scene.expert)
    np.testing.assert_allclose(found["fresh"], 1 / 4)  # its last layers are zero
    for key in ("fresh", "student"):
        model = getattr(scene, key)
        p_e, p_s = (by_hand(np.stack(x)) for x in (expert, predicted(scene, model)))
        D = (p_e * np.log(p_e / p_s)).sum(-1)  # (3, L, B)
        plain = np.stack([D[0], (D[1] + D[2]) / 2])
        np.testing.assert_allclose(found[f"{key} D"], plain.mean(2), rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(found[f"{key} error"], plain.std(2, ddof=1) / STATES ** 0.5,
                                   rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(found[key], p_s[1][:, scene.shown], rtol=1e-4)
        loss = fac.distill_loss(model, model.read(scene.obs), scene.actions, expert, CONFIG)
        np.testing.assert_allclose(found[f"{key} D"].mean(1), loss[1:], rtol=1e-4)


def test_shares_add_up_to_predictions(scene):
    for row, (head, h) in zip(tour.numbers_shares(scene).values(), ((0, 2), (1, 3))):
        assert row["h"] == h and row["shares"].shape == (3, 4)
        sums, theirs = ([x - x.mean() for x in predicted(scene, model)[head][h]]
                        for model in (scene.student, scene.expert))
        for found in (row["sum"], row["shares"].sum(0)):
            np.testing.assert_allclose(found, sums[scene.shown], atol=1e-5)
        np.testing.assert_allclose(row["expert"], theirs[scene.shown], atol=1e-4)
        assert row["r"] == pytest.approx(np.corrcoef(np.ravel(sums), np.ravel(theirs))[0, 1],
                                         abs=1e-3)


@pytest.mark.parametrize("agents", [1, 3])
def test_elites_are_the_best_and_the_mean_is_theirs(scene, agents):
    config = fac.PlannerConfig(samples=24, iterations=2, elites=4)
    z, last = scene.student.encode(scene.obs[:, 5:6]), 0
    for step in tour.search(scene, 5, agents, config):
        joints = step["samples"].transpose(0, 2, 1, 3).reshape(3, 4, 1, -1)  # each joint's own
        G = fac.h_step_return(scene.student, z, joints, config)
        np.testing.assert_allclose(step["G"], G if agents == 3 else G.sum(0)[None], rtol=1e-4)
        mean = np.zeros_like(step["mean"])
        for i in range(agents):
            best = sorted(range(24), key=lambda s, i=i, step=step: -step["G"][i, s])[:4]
            np.testing.assert_array_equal(np.sort(step["elites"][i]),
                                          np.sort(step["samples"][i][..., best]))
            scores = np.exp(0.5 * step["G"][i, best].astype(float))
            mean[i] = (step["samples"][i][..., best] * scores / scores.sum()).sum(-1)
        np.testing.assert_allclose(step["mean"], 0.1 * last + 0.9 * mean, rtol=1e-3, atol=1e-5)
        last = step["mean"]
        plan = last.transpose(0, 2, 1).reshape(3, 4, 1, 1)
        worth = [fac.h_step_return(scene.student, z, x, config).sum() for x in (plan, 0 * plan)]
        assert step["gain"] == pytest.approx(worth[0] - worth[1], abs=1e-4)


def test_one_agent_and_three_search_from_the_same_states(scene):
    found = tour.numbers_mppi(scene, fac.PlannerConfig(samples=8, iterations=2), states=3)
    assert [*found] == [1, 3] and np.shape(found[3]["gains"]) == (3, 2)
    assert found[1]["steps"][1]["mean"].shape == (1, 4, 3)
    assert found[3]["gains"][2] == [step["gain"] for step in tour.search(
        scene, 2, 3, fac.PlannerConfig(samples=8, iterations=2))]


def test_the_best_combination_is_the_best_of_each(scene):
    """Proposition 1, by trying all; and the expert's G of some combinations, one by one."""
    found, b = tour.numbers_grid(scene), scene.shown
    own, config = found["sequences"], fac.PlannerConfig()
    assert sorted(map(tuple, own)) == sorted({tuple(x) for x in own}) and own.shape == (16, 4)
    G, G_i = found["student"]["G"], found["G_i"]
    np.testing.assert_allclose(G, G_i[0][:, None, None] + G_i[1][:, None] + G_i[2], rtol=1e-4,
                               atol=1e-4)
    best = np.unravel_index(G.argmax(), G.shape)
    assert tuple(found["student"]["best"]) == best == tuple(found["each"])
    for chosen in ((0, 5, 11), (15, 2, 7)):
        actions = np.stack([own[i] for i in chosen], 1)
        G = fac.h_step_return(scene.expert, scene.expert.encode(scene.obs[:, b:b + 1]),
                              actions[None, ..., None], config)
        np.testing.assert_allclose(found["expert"]["G"][chosen], G[0, 0], rtol=1e-4)


def test_credit_s_parts_add_up_to_the_expert_s_differences(scene):
    found, b = tour.numbers_credit(scene), scene.shown
    _, q1, q2 = predicted(scene, scene.expert)
    q = (q1 + q2)[3] / 2
    np.testing.assert_allclose(found["Q"], q[b] - q[b, 0], atol=1e-4)
    np.testing.assert_allclose(found["parts"].sum(0), q[b] - q[b, 0], atol=1e-4)
    assert not found["parts"][:, 0].any() and not found["student"][:, 0].any()
    _, q1, q2 = predicted(scene, scene.credited)
    np.testing.assert_allclose(found["credited"].sum(0), ((q1 + q2)[3, b] - (q1 + q2)[3, b, 0]) / 2,
                               atol=1e-5)
    tapes = defaultdict(list)
    known = fac.predict(scene.expert, scene.expert.encode(scene.obs), scene.actions, tapes)
    parts = fac.credit(scene.expert, tapes, scene.actions, known, scene.student.config)[1][:, 3]
    _, s1, s2 = fac.run_heads(scene.credited, fac.unroll(
        scene.credited, scene.credited.encode(scene.obs), scene.actions), scene.actions)
    moved = (s1 + s2)[:, 3] / 2 - (s1 + s2)[:, 3, :, :1] / 2
    for i in range(3):
        assert found["credited r"][i] == pytest.approx(
            np.corrcoef(moved[i, :, 1:].ravel(), parts[i, :, 1:].ravel())[0, 1], abs=1e-3)


def test_costs_are_of_the_same_search(scene):
    found = tour.numbers_cost(scene, rounds=2)
    policy = [*tour.PARTS].index("proposals' policy")
    for name, row in found.items():
        assert row["seconds"].shape == (len(tour.PARTS) + 1,) and (row["seconds"] >= 0).all()
        assert (row["seconds"][policy] > 0) == (name == "expert")
        assert (row["seconds"][:policy] > 0).all()
    assert found["student"]["multiply-adds"] == 3 * found["one joint"]["multiply-adds"]
    assert found["expert"]["multiply-adds"] == multiply_adds(scene.expert.config,
                                                             fac.PlannerConfig())


def test_the_command_writes_page_and_pictures(scene, data, tmp_path, monkeypatch, capsys):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(tour, "SIZES", {"mlp_dim": 8, "latent_dim": 4})
    monkeypatch.setattr(tour, "CONFIG", CONFIG)
    monkeypatch.setattr(tour, "STATES", STATES)
    monkeypatch.setattr(fac, "load_model", lambda *arguments: (data[0], {}))
    monkeypatch.setattr(fac, "Replay", lambda path: data[1])
    assert fac.run_command(tour.make_parser(), ["--out", str(tmp_path), "--steps", "3",
                                                "--json"]) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert len(result["bytes"]) == 8 and max(result["bytes"].values()) <= 60_000
    page = (tmp_path / "tour.md").read_text("utf-8")
    assert pictures(page) == sorted(f"figures/{p.name}" for p in tmp_path.glob("figures/*"))
    with fac.one_thread():  # again: the same numbers
        known = {name: numbers(scene) for name, (numbers, *_) in tour.PICTURES.items()}
    assert page == tour.filled(tour.facts(known, CONFIG))


def test_the_command_says_in_one_line_what_is_wrong(tmp_path, capsys):
    (tmp_path / "file").touch()
    parser = tour.make_parser()
    assert fac.run_command(parser, ["--out", str(tmp_path / "file")]) == 2
    error = capsys.readouterr().err.splitlines()
    assert len(error) == 1 and "tour.md" in error[0]


# ---- What is committed.

def pictures(page):
    """Files that a page shows, sorted; each has a text in its place."""
    found = re.findall(r"!\[([^\]]*)\]\(([^)]*)\)", page)
    assert all(len(text.split()) >= 5 for text, _ in found)
    return sorted(path for _, path in found)


def test_the_page_is_the_template_s():
    """Word by word, but for the numbers."""
    parts = re.split(r"\{\w+\}", " ".join(tour.TEXT.split()))
    known = r"[-\d.,]+(?: ± [\d.]+|(?:, -?[\d.]+)*)"
    pattern = known.join(map(re.escape, parts))
    assert re.fullmatch(pattern, " ".join(PAGE.read_text("utf-8").split()))
    assert f"{tour.CONFIG.steps:,} steps" in PAGE.read_text("utf-8")


def test_the_page_is_short_and_its_names_exist():
    page = PAGE.read_text("utf-8")
    assert len(page.split()) <= 900
    for name in re.findall(r"`([\w.]+)`", page):
        if not name.endswith(".py"):
            found = fac
            for part in name.split("."):
                found = getattr(found, part)
    for link in re.findall(r"\]\(([^)]*)\)", page):
        assert (PAGE.parent / link).exists(), link


def test_pictures_are_small_and_all_are_shown():
    shown = pictures(PAGE.read_text("utf-8"))
    assert shown == sorted(f"figures/{path.name}"
                           for path in PAGE.parent.glob("figures/tour-*.png")) and len(shown) == 8
    for path in shown:
        assert (PAGE.parent / path).stat().st_size <= 60_000
