"""Mixed precision ends where metres begin, and several batches can make one step."""

import pytest
import torch
from recorded_fit import record
from tiny_runs import tiny_config
from torch.testing import assert_close

from sceneprior.paper import stages


@pytest.fixture
def watched(monkeypatch) -> list[tuple]:
    """Types of the tensors that enter every loss and every silhouette of a run."""
    seen = []

    def watch(module, name, tensors):
        original = getattr(module, name)

        def spy(*args, **kwargs):
            seen.append((name, [t.dtype for t in tensors(args)], torch.is_autocast_enabled("cpu")))
            return original(*args, **kwargs)

        monkeypatch.setattr(module, name, spy)

    def predicted(args):
        scenes, boxes = args[:2]
        return [scenes.class_logits, scenes.centers_m, scenes.sizes_m, boxes.boxes]

    watch(stages, "layout_losses", predicted)
    watch(stages, "seen_masks", lambda args: args[:1])
    return seen


def test_bfloat16_stops_at_the_network(toy_shards, tmp_path, watched):
    config = tiny_config(toy_shards, layout__epochs=2, shape__epochs=1)
    full = record(config, tmp_path / "full", 1)
    watched.clear()
    mixed = record(config, tmp_path / "mixed", 1, precision="bf16-mixed")
    assert {name for name, _, _ in watched} == {"layout_losses", "seen_masks"}
    for _, types, autocast in watched:
        assert set(types) == {torch.float32} and not autocast
    one, other = (
        torch.cat([step[name].flatten() for name in sorted(step) if name.startswith("gradient")])
        for step in (full[0], mixed[0])
    )
    assert not torch.equal(one, other)  # the network did run in fewer bits
    assert torch.cosine_similarity(one, other, dim=0) > 0.99
    for whole, half in zip(full, mixed, strict=True):
        assert float(half["loss"]) == pytest.approx(float(whole["loss"]), rel=0.02)


@pytest.mark.slow
def test_two_batches_make_one_step_as_one_twice_as_large(toy_shards, tmp_path):
    """Equal but for objects being averaged in each batch; each batch has a seed of its own."""
    small = {"layout__batch_size": 6, "layout__accumulate": 2, "layout__latent_noise": 0.3}
    steps = record(
        tiny_config(toy_shards, layout__epochs=1, shape__epochs=1, **small), tmp_path / "a", 1
    )
    assert len(steps) == 1 + 2  # 12 rooms; the shape stage as ever

    plain = {"layout__epochs": 1, "shape__epochs": 1, "layout__learning_rate": 1e-12}
    plain |= {"layout__latent_learning_rate": 1e-12, "layout__batch_size": 6}
    single = record(tiny_config(toy_shards, **plain), tmp_path / "b", 1)
    twice = record(tiny_config(toy_shards, **plain, layout__accumulate=2), tmp_path / "c", 1)
    for name in single[0]:
        if name.startswith("gradient/prior.") and name in twice[0]:
            mean = (single[0][name] + single[1][name]) / 2
            assert_close(twice[0][name], mean, rtol=1e-4, atol=1e-6)
