"""Whole reconstructions on a toy run: options, refinement, answers in the masks' order."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from sceneprior.classes import label_set
from sceneprior.config import load_run
from sceneprior.errors import InputError
from sceneprior.reconstruction import reconstruct as reconstruct_module
from sceneprior.reconstruction.fit import (
    SCHEDULES,
    FitSchedule,
    decode_images,
    fit_latents,
    view_loss,
)
from sceneprior.reconstruction.observed import as_views, images_of_split
from sceneprior.reconstruction.reconstruct import FitOptions, reconstruct, unlearnt_classes
from sceneprior.reconstruction.refinement import refine


@pytest.fixture(scope="module")
def trained(toy_run):
    return load_run(toy_run)


@pytest.fixture(scope="module")
def images(toy_shards):
    return images_of_split(toy_shards, "test", 0)[0]


@pytest.fixture(scope="module")
def views(images):
    return as_views(images, 4)


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setitem(SCHEDULES, "short", FitSchedule(steps=10, drop_at=6, patience=0))


def test_objects_answer_for_masks_in_their_order(trained, images):
    found = reconstruct(trained, images, FitOptions("short"))
    assert [one.image.name for one in found] == [image.name for image in images]
    for one in found:
        assert len(one.scene.objects) == len(one.image.rows)
        for item in one.scene.objects:
            assert item.mesh is not None and item.label != "void"
            low, high = item.mesh.vertices_m.min(axis=0), item.mesh.vertices_m.max(axis=0)
            np.testing.assert_allclose((low + high) / 2, item.center_m, atol=1e-4)
            np.testing.assert_allclose(high - low, item.size_m, atol=1e-4)


def test_images_of_any_size_and_number_come_back_in_their_order(trained, images, monkeypatch):
    half = replace(
        images[1],
        instance_ids=images[1].instance_ids[::2, ::2],
        intrinsics=np.diag([0.5, 0.5, 1]) @ images[1].intrinsics,
    )
    monkeypatch.setattr(reconstruct_module, "BATCH", 2)
    given = [images[3], half, images[0], images[2]]
    found = reconstruct(trained, given, FitOptions("short"))
    assert [one.image is image for one, image in zip(found, given, strict=True)] == [True] * 4
    alone = reconstruct(trained, [images[0]], FitOptions("short"))[0]
    assert found[2].score == pytest.approx(alone.score, rel=1e-3)


def test_more_restarts_are_never_worse_and_the_best_is_kept(trained, images):
    one, three = (reconstruct(trained, images, FitOptions("short", restarts=n)) for n in (1, 3))
    # The first start is the same; sums in another order may move its score a little.
    assert all(b.score <= a.score + 1e-3 for a, b in zip(one, three, strict=True))
    assert any(b.score < a.score - 1e-3 for a, b in zip(one, three, strict=True))


def test_options_and_images_that_cannot_be(trained, images):
    with pytest.raises(InputError, match="No schedule is called 'long'; choose from paper, rele"):
        reconstruct(trained, images, FitOptions("long"))
    with pytest.raises(InputError, match="restarts is 0; an image needs at least one"):
        reconstruct(trained, images, FitOptions(restarts=0))
    other = replace(images[0], label_set="scannet")
    with pytest.raises(InputError, match="label set 'scannet', but the run was trained on 'front3"):
        reconstruct(trained, [other], FitOptions("short"))


def test_classes_that_the_run_never_generates(trained, images):
    names = label_set(images[0].label_set)
    with torch.no_grad():
        rooms = [trained.prior(row.unsqueeze(0), False).class_logits[0] for row in trained.logits]
    generated = {int(slot.argmax()) for room in rooms for slot in room}
    assert names.index("sofa") not in generated  # no toy room has one
    learnt = [index for index in sorted(generated) if index]
    image = replace(images[0], object_class=np.array([names.index("sofa"), *learnt]))
    assert unlearnt_classes(trained, [image]) == ["sofa"]


def displaced(trained, views, by_m: float):
    """What a fit finds, with every box and mesh moved along x."""
    fit = fit_latents(
        trained, views, trained.prior.latent_space(trained.logits[:1]).expand(4, -1),
        FitSchedule(steps=40, drop_at=30),
    )  # fmt: skip
    step = torch.tensor([by_m, 0, 0])
    scenes = replace(
        fit.scenes,
        centers_m=fit.scenes.centers_m + step,
        vertices_m=fit.scenes.vertices_m + step,
    )
    with torch.no_grad():
        return fit, replace(fit, scenes=scenes, loss=view_loss(trained, scenes, views))


def test_refinement_never_worsens_and_brings_displaced_boxes_nearer(trained, views):
    fit, aside = displaced(trained, views, 0.15)
    found = refine(trained, views, aside, 60)
    assert (found.loss.score <= aside.loss.score).all()
    assert found.loss.score.mean() < (aside.loss.score.mean() + fit.loss.score.mean()) / 2
    again = view_loss(trained, found.scenes, views, matches=found.loss.matches)
    assert_close(again.score, found.loss.score, rtol=1e-5, atol=1e-6)
    real = views.is_object
    floor = (found.scenes.centers_m - found.scenes.sizes_m / 2)[..., 1][real]
    before = (aside.scenes.centers_m - aside.scenes.sizes_m / 2)[..., 1][real]
    assert (floor >= before.clamp(max=0) - 1e-5).all()  # none sinks into the floor


def test_meshes_move_and_stretch_with_their_boxes(trained, views):
    _, aside = displaced(trained, views, 0.15)
    scenes = refine(trained, views, aside, 20).scenes
    assert not torch.equal(scenes.sizes_m, aside.scenes.sizes_m)
    real = views.is_object
    low, high = scenes.vertices_m[real].amin(dim=1), scenes.vertices_m[real].amax(dim=1)
    assert_close((low + high) / 2, scenes.centers_m[real], rtol=0, atol=1e-4)
    assert_close(high - low, scenes.sizes_m[real], rtol=0, atol=1e-4)


def test_without_steps_refinement_changes_nothing(trained, views):
    start = trained.prior.latent_space(trained.logits[:1]).expand(4, -1)
    fit = fit_latents(trained, views, start, FitSchedule(steps=2, drop_at=1))
    found = refine(trained, views, fit, 0)
    assert_close(found.scenes.centers_m, decode_images(trained, fit.z, views).centers_m)
    assert torch.equal(found.loss.score, fit.loss.score)
