"""ReDo in the critics: when neurons are recycled, which ones, and what it leaves alone."""

from pathlib import Path
from typing import Any

import pytest
import torch

from sb3_sample import SAC
from sb3_sample.learner import plasticity
from tests.sac.common import bro, differing, random_batch, sac, state, taken_or_refused, vec
from tests.sac.test_update import NoSynchronisation


def test_every_period_and_only_then(monkeypatch: pytest.MonkeyPatch) -> None:
    model = sac(redo_period=3, redo_threshold=0.07)
    at: list[int] = []
    thresholds: set[float] = set()
    recycle = plasticity.recycle

    def recorded(trunk: Any, head: Any, x: torch.Tensor, threshold: float, optimizer: Any) -> torch.Tensor:
        assert trunk is model.critic.trunk and head is model.critic.head and optimizer is model.critic.optimizer
        assert x.shape == (8, 5)
        at.append(model._n_updates)
        thresholds.add(threshold)
        return recycle(trunk, head, x, threshold, optimizer)

    monkeypatch.setattr(plasticity, "recycle", recorded)
    for _ in range(10):
        metrics = model._update(random_batch(model))
        assert ("plasticity/n_recycled" in metrics) == (model._n_updates % 3 == 0)
    assert at == [3, 6, 9] and thresholds == {0.07}


def test_not_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plasticity, "recycle", None)
    model = sac()
    assert model.redo is None
    assert "plasticity/n_recycled" not in model._update(random_batch(model))


def silent(model: SAC, batch: Any) -> list[torch.Tensor]:
    """By hand, for each of two hidden layers: which neurons of which critic are 0 on the whole batch, (E, N)."""
    first, second = model.critic.trunk.layers[0], model.critic.trunk.layers[2]
    x = torch.cat((batch.observations, batch.actions), dim=1)
    h = torch.relu(torch.einsum("bi,eij->ebj", x, first.weight) + first.bias)
    g = torch.relu(torch.einsum("ebi,eij->ebj", h, second.weight) + second.bias)
    return [(h == 0).all(dim=1), (g == 0).all(dim=1)]


def test_a_dead_neuron_by_hand() -> None:
    """Neuron 5 of the second critic's first layer, silent: only it changes, and the critics' values do not."""
    model = sac(redo_period=1000, redo_threshold=0.0, learning_rate=1e-2)
    batch = random_batch(model)
    model._update(batch)
    first, second = model.critic.trunk.layers[0], model.critic.trunk.layers[2]
    with torch.no_grad():
        for target in (model.critic, model.critic_target):
            target.trunk.layers[0].bias[1, 0, 5] = -1e6
    with torch.no_grad():
        dead = silent(model, batch)
        q = model.critic(batch.observations, batch.actions)
    assert dead[0][1, 5]
    before = {name: p.detach().clone() for name, p in model.critic.named_parameters()}
    target_before, others = [p.clone() for p in model.critic_target.parameters()], state(model)
    moments = model.critic.optimizer.state
    for p in (first.weight, first.bias, second.weight):
        moments[p]["exp_avg"].fill_(0.5)
        moments[p]["exp_avg_sq"].fill_(0.25)

    model._n_updates = 1000
    metrics = model.redo.after_update(model.learner, batch)
    assert metrics["plasticity/n_recycled"].item() == int(dead[0].sum() + dead[1].sum()) >= 1
    after = {name: p.detach() for name, p in model.critic.named_parameters()}
    # Fresh incoming weights, no bias, no outgoing weights; the living neurons keep theirs.
    assert after["trunk.layers.0.bias"][1, 0, 5] == 0
    assert not torch.equal(after["trunk.layers.0.weight"][1, :, 5], before["trunk.layers.0.weight"][1, :, 5])
    assert (after["trunk.layers.2.weight"][1, 5] == 0).all()
    for e in range(2):
        alive = ~dead[0][e]
        assert torch.equal(after["trunk.layers.0.weight"][e][:, alive], before["trunk.layers.0.weight"][e][:, alive])
        both = alive[:, None] & ~dead[1][e][None]
        assert torch.equal(after["trunk.layers.2.weight"][e][both], before["trunk.layers.2.weight"][e][both])
        kept = ~dead[1][e]
        assert torch.equal(after["head.weight"][e][kept], before["head.weight"][e][kept])
    with torch.no_grad():
        torch.testing.assert_close(model.critic(batch.observations, batch.actions), q)
    # The optimizer forgets what belongs to the recycled weights, and nothing else.
    for key, full in (("exp_avg", 0.5), ("exp_avg_sq", 0.25)):
        expected = torch.where(dead[0][:, None], 0.0, full)
        assert torch.equal(moments[first.weight][key], expected.expand_as(first.weight))
        assert torch.equal(moments[first.bias][key], expected)
        outgoing = torch.where(dead[0][:, :, None] | dead[1][:, None], 0.0, full)
        assert torch.equal(moments[second.weight][key], outgoing)
    # Targets and everything else stay.
    assert all(torch.equal(a, b) for a, b in zip(target_before, model.critic_target.parameters(), strict=True))
    changed = differing(others, state(model))
    assert changed and all(name.startswith(("policy/critic.", "critic.optimizer/")) for name in changed), changed


@pytest.mark.parametrize("kwargs", [{}, {"n_quantiles": 5}, {"policy_kwargs": {"net_arch": [8], "n_critics": 3}}])
def test_learns_without_waiting_for_the_device(kwargs: dict[str, Any]) -> None:
    model = sac(redo_period=2, redo_threshold=0.5, learning_rate=1e-2, **kwargs).learn(20)
    assert all(torch.isfinite(p).all() for p in model.policy.parameters())
    batch = random_batch(model)
    for _ in range(2):
        with NoSynchronisation():
            model._update(batch)


def test_in_bro() -> None:
    """Neurons inside the residual blocks are recycled; all of them at a threshold above every score."""
    model = bro(redo_period=2, redo_threshold=1e9)
    metrics = [model._update(random_batch(model)) for _ in range(2)]
    # Two critics, one block of width 8.
    assert metrics[1]["plasticity/n_recycled"].item() == 16
    assert (model.critic.trunk.blocks[0].dense2.weight == 0).all()


def test_the_log_tells(tmp_path: Path) -> None:
    from stable_baselines3.common.logger import configure

    model = sac(redo_period=1, redo_threshold=1e9)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(22, log_interval=1)
    header, *rows = (tmp_path / "progress.csv").read_text().splitlines()
    # Two critics, two layers of 8; the episode of 7 steps ends within the warm-up.
    column = header.split(",").index("plasticity/n_recycled")
    assert [float(row.split(",")[column] or "nan") for row in rows[1:]] == [32, 32]


@pytest.mark.parametrize(
    ("name", "value"),
    [("redo_period", 0), ("redo_period", -3), ("redo_period", 1.5), ("redo_period", True), ("redo_threshold", -0.1),
     ("redo_threshold", float("nan"))],
)  # fmt: skip
def test_bad_arguments(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=name) as caught:
        sac(**{"redo_period": 5, name: value})
    assert str(value) in str(caught.value)


@pytest.mark.parametrize("period", [4, None])
def test_arguments_at_loading(period: int | None, tmp_path: Path) -> None:
    sac(redo_period=7).save(tmp_path / "m")
    if period is None:
        # The file's part has no state to lose: it goes, or the argument is refused.
        loaded = taken_or_refused(lambda: SAC.load(tmp_path / "m", env=vec(), redo_period=None), "redo")
        assert loaded is None or loaded.redo is None
        return
    loaded = SAC.load(tmp_path / "m", env=vec(), redo_period=period, redo_threshold=0.3)
    assert (loaded.redo.period, loaded.redo.threshold) == (4, 0.3)
    recycled = [loaded._n_updates for _ in range(9) if "plasticity/n_recycled" in loaded._update(random_batch(loaded))]
    assert recycled == [4, 8]


def test_added_at_loading(tmp_path: Path) -> None:
    """Recycling is no network: a model saved without it can go on with it, or says that it cannot."""
    sac().save(tmp_path / "m")
    loaded = taken_or_refused(lambda: SAC.load(tmp_path / "m", env=vec(), redo_period=4), "redo")
    assert loaded is None or loaded.redo.period == 4
