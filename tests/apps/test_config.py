"""Configs: every shipped one loads, and every mistake is a sentence that names its place."""

from pathlib import Path

import pytest
import yaml
from refusals import refused
from tiny_runs import write_tiny_config

from sceneprior.apps.config import load_config
from sceneprior.core.classes import label_set
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.settings import apply_override, as_value, dump_settings, find_config
from sceneprior.paper.settings import Steps

FOLDER = Path(__file__).parents[2] / "configs"
SHIPPED = sorted(set(FOLDER.rglob("*.yaml")) - set(FOLDER.glob("compare/*.yaml")))
PRIORS = [path for path in SHIPPED if path.parent.name != "baselines"]


def name_of(path: Path) -> str:
    return path.relative_to(FOLDER).as_posix()


@pytest.fixture
def config(tmp_path) -> Path:
    return write_tiny_config(tmp_path / "tiny.yaml", Path("shards"))


@pytest.mark.parametrize("path", SHIPPED, ids=name_of)
def test_shipped_configs_load_and_survive_being_saved(path, tmp_path):
    config = load_config(str(path))
    dump_settings(config, tmp_path / "saved.yaml")
    assert load_config(str(tmp_path / "saved.yaml")) == config


@pytest.mark.parametrize(
    "text",
    ["my #1/shards", "2024", "true", "a: b", "plain/path", "~", "", " a", "1e5", "[x", "é #"],
)
def test_texts_of_commands_are_read_as_they_are(text):
    data = {}
    apply_override(data, f"data.shards={as_value(text)}")
    assert data == {"data": {"shards": text}}
    assert (as_value(text) == text) == (text == "plain/path")


@pytest.mark.parametrize("path", SHIPPED, ids=name_of)
def test_shipped_configs_are_complete(path):
    """No setting is left to a default, so that a diff of two files shows how two runs differ; apart
    from arguments of Lightning, and from weights to start with."""

    def keys(data, prefix=""):
        for key, value in data.items():
            yield from keys(value, f"{prefix}{key}.") if isinstance(value, dict) else [prefix + key]

    config = load_config(str(path))
    everything = config.model_dump(mode="json", by_alias=True, exclude={"callbacks", "init_from"})
    assert set(keys(yaml.safe_load(path.read_text()))) == set(keys(everything))


@pytest.mark.parametrize(
    ("name", "objects", "classes", "mask_step"),
    # ScanNet's shards are written at a quarter of the images' size.
    [("bedroom", 13, 22, 4), ("living", 28, 15, 4), ("scannet", 53, 19, 1)],
)
def test_the_papers_numbers(name, objects, classes, mask_step):
    config = load_config(f"{name}.yaml")
    assert len(label_set(config.label_set)) == classes
    model = config.model
    assert (model.max_objects, model.width) == (objects, 512)
    assert (model.decoder.heads, model.decoder.hidden, model.decoder.dropout) == (4, 1024, 0.1)
    assert model.decoder.final_norm and not model.decoder.query_self_attention
    assert (config.data.views_per_room, config.data.mask_step) == (20, mask_step)
    assert config.data.augment_rotations and config.data.view_fraction == 1
    for stage, epochs in ((config.layout, 800), (config.shape, 500)):
        assert (stage.epochs, stage.batch_size, stage.accumulate) == (epochs, 16, 1)
        assert stage.learning_rate == stage.latent_learning_rate == 1e-4
        assert stage.schedule == Steps(milestones=(300,), decay=0.1)
        assert stage.latent_noise == stage.clip_gradient == 0
    loss = config.loss
    assert (loss.class_, loss.completeness, loss.frustum, loss.box, loss.mask) == (1, 1, 1, 5, 2)
    assert (loss.match_box, loss.iou_gate, loss.occlusion_slack) == (5.0, 0.5, 1.0)
    assert config.layout.proxy == "ellipsoid" and config.shape.compositing == "paper"
    assert (model.shape.template, model.shape.fit_box, model.shape.level) == ("sphere", False, 4)
    assert (config.shape.silhouettes, config.shape.box_from) == ("exact", "mesh")


def settings_of(name: str) -> dict[str, object]:
    def flat(data, prefix=""):
        for key, value in data.items():
            yield from (
                flat(value, f"{prefix}{key}.")
                if isinstance(value, dict)
                else [(prefix + key, value)]
            )

    return dict(flat(load_config(name).model_dump(mode="json", by_alias=True)))


@pytest.mark.parametrize("room", ["bedroom", "living"])
def test_the_head_of_a_small_config_names_each_key_that_is_not_the_papers(room):
    paper, small = settings_of(f"paper/{room}.yaml"), settings_of(f"paper/{room}_small.yaml")
    head = find_config(f"paper/{room}_small.yaml").read_text().split("method:")[0]
    changed = {key for key in paper if paper[key] != small[key]}
    assert paper.keys() == small.keys() and changed
    assert [key for key in sorted(changed) if key not in head] == []
    kept = ("loss.", "layout.", "model.latent_space.", "model.decoder.dropout", "sampling.")
    assert [key for key in changed if key.startswith(kept)] == ["layout.learning_rate"]


def test_the_released_codes_numbers():
    """Settings of the released code that differ from those of the paper, and no others."""
    paper, released = settings_of("paper/bedroom.yaml"), settings_of("paper/released.yaml")
    assert {key: released[key] for key in paper if released[key] != paper[key]} == {
        "data.augment_rotations": False,
        "model.max_objects": 15,
        "model.decoder.hidden": 512,
        "model.decoder.query_self_attention": True,
        "model.decoder.step_mlps": True,
        "model.layout_heads": "separate",
        "model.completeness_target": "stop",
        "loss.passing_masks_only": True,
        "layout.epochs": 850,
        "layout.latent_epochs": 50,
        "layout.batch_size": 128,
        "layout.schedule.milestones": [400],
        "layout.keep": "lowest",
        "shape.epochs": 550,
        "shape.latent_epochs": 50,
        "shape.keep": "lowest",
    }


@pytest.mark.parametrize("path", PRIORS, ids=name_of)
def test_no_shipped_config_is_a_variant_an_ablation_or_draws_near_copies(path):
    config = load_config(str(path))
    assert config.distribution in ("paper", "sampler")
    model, released = config.model, path.stem == "released"
    assert config.stage_names[:2] in (("layout", "shape"), ("shape",), ("shape", "sampler"))
    assert config.method == "lifted" or config.layout is not None, "one stage is ablation c3"
    assert (model.latent_space.name, model.decoder.name) == ("sphere", "transformer")
    decoder = model.decoder
    parts = (
        model.completeness_target == "stop", model.layout_heads == "separate",
        decoder.query_self_attention, decoder.step_mlps,
    )  # fmt: skip
    assert set(parts) == {released}
    of_paper = path.parent.name == "paper" and not path.stem.endswith("_tuned")
    assert decoder.final_norm == decoder.unit_start == of_paper


def test_a_former_section_that_asks_for_nothing_is_dropped(config):
    for former in ("{every: 0, count: 200, seed: 0, metric: category_kl}", "{count: 5}", "{}"):
        assert load_config(str(config), (f"samples={former}",)) == load_config(str(config))


def test_a_shipped_config_is_found_by_name_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_config("demo.yaml").samefile(FOLDER / "demo.yaml")
    assert load_config("demo.yaml").data.shards == "out/demo/shards"
    assert find_config("bedroom.yaml").samefile(FOLDER / "paper" / "bedroom.yaml")
    assert find_config("lifted/bedroom.yaml").samefile(FOLDER / "lifted" / "bedroom.yaml")
    assert find_config("gan.yaml").samefile(FOLDER / "baselines" / "gan.yaml")
    # A file of that name here comes first.
    write_tiny_config(tmp_path / "demo.yaml", Path("mine"))
    assert load_config("demo.yaml").data.shards == "mine"


def test_set_overrides_what_the_file_says(config):
    loaded = load_config(
        str(config),
        ("model.width=32", "loss.class=0.5", "shape.sigma_px2=null", 
         "layout.schedule.milestones=[1, 2]",
         "data.shards=elsewhere", "layout.learning_rate=1e-2"),
    )  # fmt: skip
    assert (loaded.model.width, loaded.loss.class_, loaded.shape.sigma_px2) == (32, 0.5, None)
    assert loaded.layout.schedule.milestones == (1, 2) and loaded.data.shards == "elsewhere"
    assert loaded.layout.learning_rate == 0.01
    plain = load_config(str(config))
    assert plain.model.width == 16


# -- Refusals --------------------------------------------------------------------------------------

CHANGES = {
    "no_method": ("method: paper", "stages: two"),
    "key_of_model": ("  width: 16", "  widht: 16"),
    "key_of_loss": ("loss: {}", "loss: {clas: 1.0}"),
    "key": ("label_set:", "labelset: x\nlabel_set:"),
    "no_integer": ("  width: 16", "  width: wide"),
    "no_boolean": ("    fit_box: true", "    fit_box: 1"),
    "too_small": ("  epochs: 6", "  epochs: 0"),
    "heads": ("    heads: 2", "    heads: 3"),
    "missing": ("  epochs: 6\n", ""),
    "label_set": ("label_set: front3d_bedroom", "label_set: attic"),
    "class_twice": ("label_set: front3d_bedroom", "label_set: 'void,bed,bed'"),
    "no_section": ("loss: {}", "loss: 3"),
    "two_mistakes": ("  width: 16", "  widht: 16\n  heigth: 3"),
    "long_key": ("seed: 3", f"{'ab' * 500}: 3"),
}
OVERRIDES = {
    "samples": "samples={every: 25}",
    "section_of_lifted": "sampler={epochs: 2}",
    "section_of_baselines": "training.epochs=3",
    "key": "data.shard=mine",
    "no_value": "model.width",
    "too_deep": "model.width.deep=3",
    "no_yaml": "model.width=[",
    "key_of_variant": "model.decoder={name: lstm, step_mlps: true}",
    "variant": "model.decoder={name: gru}",
    "variant_unnamed": "model.decoder=lstm",
    "variant_without_name": "model.latent_space={anchors: 4}",
    "method": "method=nerf",
    "method_type": "method=[a]",
    "large_seed": "seed=4294967296",
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_mistake_in_the_file_is_a_sentence(config, tmp_path, name):
    text, (old, new) = config.read_text(), CHANGES[name]
    assert old in text
    config.write_text(text.replace(old, new, 1))
    with refused(f"apps/config_{name}", ConfigError, tmp=tmp_path):
        load_config(str(config))


@pytest.mark.parametrize("name", [*OVERRIDES, "of_paper"])
def test_a_mistake_in_an_override_is_a_sentence(config, tmp_path, name):
    where, override = str(config), OVERRIDES.get(name)
    if override is None:
        where, override = "demo.yaml", "loss.occlusion_slack=1"
    with refused(f"apps/override_{name}", ConfigError, tmp=tmp_path, configs=FOLDER):
        load_config(where, (override,))


def test_no_such_config_lists_the_shipped_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ", ".join(sorted(name_of(path) for path in FOLDER.rglob("*.yaml")))
    for name in ("nowhere.yaml", "sub/demo.yaml"):
        with pytest.raises(ConfigError) as error:
            load_config(name)
        assert str(error.value) == (
            f"No config '{name}': it is neither a file nor one of the shipped {names}."
        )


NO_CONFIGS = {
    "list": b"- a\n",
    "open": b"a: [1,\n",
    "bytes": b"\xff\xfe\x00",
    "date": b"x: 2001-99-99",
    "size": b"#" * 2**20 + b"\nx: 1",
}


@pytest.mark.parametrize("name", NO_CONFIGS)
def test_a_file_that_is_no_config_is_a_sentence(tmp_path, name):
    path = tmp_path / "odd.yaml"
    path.write_bytes(NO_CONFIGS[name])
    with pytest.raises(InputError, match=r"odd\.yaml (holds no settings|is not a YAML|cannot be)"):
        load_config(str(path))
