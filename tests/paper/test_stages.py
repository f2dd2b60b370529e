"""The optimiser of the paper's stages: which rate trains what, and when it falls."""

import pytest
from tiny_runs import tiny_config

from sceneprior.paper.stages import LayoutStage, ShapeStage


def test_adam_has_a_rate_for_each_part_and_all_fall_tenfold_at_the_milestone(tmp_path):
    rates = {"learning_rate": 1e-4, "latent_learning_rate": 3e-4}
    rates["schedule"] = {"name": "steps", "milestones": [3], "decay": 0.1}
    config = tiny_config(tmp_path, **{f"layout__{key}": value for key, value in rates.items()})
    prior, latents = config.build_prior(), config.build_latents(2)
    stage = LayoutStage(config, config.layout, prior, latents)
    of = stage.configure_optimizers()
    groups, schedule = of["optimizer"].param_groups, of["lr_scheduler"]
    seen = []
    for _ in range(4):
        seen.append([group["lr"] for group in groups])
        of["optimizer"].step()
        schedule.step()
    first = [1e-4, config.layout.shape_rate, 3e-4]
    assert seen[:3] == [first] * 3
    assert seen[3] == pytest.approx([rate / 10 for rate in first], rel=1e-12)
    trained = {id(p) for group in groups for p in group["params"] if p.requires_grad}
    shape = {id(p) for p in prior.shape.parameters()}
    assert id(latents.weight) in {id(p) for p in groups[2]["params"]}
    assert not trained & shape, "layouts are trained without decoding shapes"
    assert trained | shape >= {id(p) for p in (*prior.decoder.parameters(), latents.weight)}
    ShapeStage(config, config.shape, prior, latents)
    assert all(p.requires_grad for p in prior.shape.parameters())
