"""What lifting, decoding, the losses and fitting give on toy rooms, against `golden/learning.json`.

`TAKE=1 pytest tests/lifted/test_golden.py` writes the file anew. Numbers have a tolerance,
since processors round differently.
"""

import json

import numpy as np
import pytest
import torch
from golden_values import FOLDER, TAKE
from tiny_runs import tiny_config, tiny_lifted

from sceneprior.core.views import as_views
from sceneprior.lifted.reconstruction.objects import answer_images
from sceneprior.lifted.stages import latent_loss, lifted_losses, match_lifted, shape_code_loss
from sceneprior.lifted.trained import TrainedLifted
from sceneprior.paper.fit_image import FitSchedule, fit_latents_to_images
from sceneprior.paper.interpolate import interpolate
from sceneprior.paper.losses import layout_losses, mask_loss, seen_masks
from sceneprior.paper.matching import seen_boxes
from sceneprior.paper.prior import TrainedPrior

GOLDEN = FOLDER / "learning.json"


def untrained(config):
    """The network, with weights from the seed alone, and objects that differ and are kept."""
    prior = config.build_prior().eval().requires_grad_(False)
    rows = prior.layout.mlp2.rows()
    for weight, _ in rows:
        weight *= 10
    rows[-1][1].fill_(2.0)
    return prior


@pytest.fixture(scope="module")
def paper(toy_shards):
    """An untrained prior of the paper's method."""
    config = tiny_config(toy_shards)
    prior = untrained(config)
    logits = config.build_latents(12).weight.detach() * 2
    return TrainedPrior(prior, tuple(f"room_{k}" for k in range(12)), config, "shape", logits)


@pytest.fixture(scope="module")
def rooms(toy_shards):
    """The toy rooms, lifted."""
    return tiny_lifted(toy_shards).open_lifted()


@pytest.fixture(scope="module")
def lifted(toy_shards, rooms):
    """An untrained prior of the lifted method, with the toy rooms' prototypes."""
    config = tiny_lifted(toy_shards)
    prior = untrained(config)
    prior.shape.set_prototypes(rooms.find_prototypes(config.model.shape.prototypes))
    logits = config.build_latents(12).weight.detach() * 2
    return TrainedLifted(prior, tuple(rooms.plain_ids), config, "shape", logits)


def check(name: str, **found) -> None:
    values = {key: np.asarray(value, dtype=np.float64).round(6) for key, value in found.items()}
    known = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {}
    if TAKE:
        known[name] = {key: value.tolist() for key, value in values.items()}
        lines = (f"{json.dumps(key)}: {json.dumps(known[key])}" for key in sorted(known))
        GOLDEN.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    for key, value in values.items():
        np.testing.assert_allclose(value, known[name][key], rtol=1e-3, atol=2e-3, err_msg=key)


def test_lifted_boxes_and_shapes(rooms):
    first = sum(rooms.counts[:3])
    filled = rooms.hulls().mean(axis=(1, 2, 3))
    check(
        "boxes",
        centers_m=rooms.boxes.centers_m[:first],
        sizes_m=rooms.boxes.sizes_m[:first],
        explained=rooms.boxes.explained[:first],
        filled=filled[:12],
        hits=rooms.rays.hits[:12].mean(axis=1),
        lengths=np.linalg.norm(rooms.rays.spans[:12].astype(float), axis=2).mean(axis=1),
    )


def test_prototypes_and_the_poses_in_which_objects_show_them(rooms, lifted):
    prototypes = lifted.prior.shape.prototypes
    check(
        "prototypes",
        labels=prototypes.object_class,
        sizes_m=prototypes.sizes_m,
        common=prototypes.common,
        filled=prototypes.grids.mean(axis=(1, 2, 3)),
        parts=[len(each.kind) for each in prototypes.parts],
        looks=rooms.posed_prototypes(prototypes)[0],
    )


def test_decoded_scenes(paper, lifted):
    mine, theirs = paper.prior(paper.logits[:2]), lifted.prior(lifted.logits[:2])
    check(
        "decoded",
        class_logits=mine.class_logits,
        centers_m=mine.centers_m,
        sizes_m=mine.sizes_m,
        completeness=mine.completeness_logits,
        bevels=mine.bevels,
        vertices_m=mine.vertices_m[0, :2],
        codes=theirs.shape_codes,
        looks=theirs.looks,
    )


def test_losses_of_views(paper, images):
    views = as_views(images, 4)
    scenes = paper.prior.decode(paper.prior.latent_space(paper.logits[:4]), views.object_places)
    weights, stage = paper.config.loss, paper.config.shape
    boxes = seen_boxes(scenes, views, stage.proxy, stage.box_from)
    proxies = {name: seen_boxes(scenes, views, name).boxes for name in ("ellipsoid", "beveled_box")}
    losses, matches = layout_losses(scenes, boxes, views, weights, "first_n")
    masks = seen_masks(scenes.vertices_m, paper.prior.shape.faces, views, stage)
    losses["mask"], overlap = mask_loss(masks, views, matches, 0.0)
    check("view_losses", predictions=matches.prediction, **proxies, **losses, **overlap)


def test_losses_against_lifted_boxes(lifted, rooms):
    rooms.assign_prototypes(lifted.prior.shape.prototypes)
    batch = rooms.__getitems__([(0, 0), (3, 0)])
    scenes = lifted.prior(lifted.logits[[0, 3]])
    matches = match_lifted(scenes, batch)
    known = matches._replace(valid=matches.valid & (batch.looks >= 0))
    targets = lifted.prior.shape.targets(batch.looks.clamp(min=0))
    generator = torch.Generator().manual_seed(0)
    check(
        "lifted_losses",
        **lifted_losses(scenes, batch, matches, "first_n"),
        shape=shape_code_loss(scenes, known, *targets),
        latents=latent_loss(lifted.logits, True, generator),
    )


def test_interpolated_rooms(paper, lifted):
    for name, trained in (("paper", paper), ("lifted", lifted)):
        scenes = interpolate(trained, "seed:1", "seed:2", 4)
        check(
            f"interpolated_{name}",
            counts=[len(scene.objects) for scene in scenes],
            centers_m=np.concatenate([scene.centers_m for scene in scenes]),
            sizes_m=np.concatenate([scene.sizes_m for scene in scenes]),
            spread_m=[
                item.mesh.vertices_m.std(axis=0) for scene in scenes for item in scene.objects
            ],
        )


def test_latents_fitted_to_images(paper, images):
    schedule = FitSchedule(steps=12, drop_at=6)
    start = paper.prior.latent_space(paper.logits[:4])
    fit = fit_latents_to_images(paper, as_views(images, 4), start, schedule)
    check("fitted", total=fit.loss.total, score=fit.loss.score, centers_m=fit.scenes.centers_m)


def test_images_reconstructed_object_by_object(paper, images):
    answers = answer_images(paper, images)
    check(
        "reconstructed",
        energy=[answer.energy for answer in answers],
        centers_m=np.concatenate([answer.scene.centers_m for answer in answers]),
        sizes_m=np.concatenate([answer.scene.sizes_m for answer in answers]),
    )
