"""Configs: every shipped one loads, and every mistake is a sentence that names its place."""

from itertools import pairwise
from pathlib import Path

import pytest
import yaml
from tiny_runs import write_tiny_config

from sceneprior.apps.config import METHODS, load_config
from sceneprior.core.classes import LABEL_SETS, label_set
from sceneprior.core.errors import ConfigError
from sceneprior.core.settings import check_settings, dump_settings, find_config
from sceneprior.paper.config import PaperConfig
from sceneprior.paper.settings import Steps

FOLDER = Path(__file__).parents[2] / "configs"
SHIPPED = sorted(set(FOLDER.rglob("*.yaml")) - set(FOLDER.glob("compare/*.yaml")))
PRIORS = [path for path in SHIPPED if path.parent.name != "baselines"]


def name_of(path: Path) -> str:
    return path.relative_to(FOLDER).as_posix()


@pytest.fixture
def config(tmp_path) -> Path:
    return write_tiny_config(tmp_path / "tiny.yaml", Path("shards"))


def refusal(path, *overrides) -> str:
    with pytest.raises(ConfigError) as error:
        load_config(str(path), overrides)
    message = str(error.value)
    assert "\n" not in message and "pydantic" not in message
    return message


def replaced(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize("path", SHIPPED, ids=name_of)
def test_shipped_configs_load_and_survive_being_saved(path, tmp_path):
    config = load_config(str(path))
    dump_settings(config, tmp_path / "saved.yaml")
    assert load_config(str(tmp_path / "saved.yaml")) == config


@pytest.mark.parametrize("path", SHIPPED, ids=name_of)
def test_shipped_configs_are_complete(path):
    """No setting is left to a default, so that a diff of two files shows how two runs differ."""

    def keys(data, prefix=""):
        for key, value in data.items():
            yield from keys(value, f"{prefix}{key}.") if isinstance(value, dict) else [prefix + key]

    everything = load_config(str(path)).model_dump(mode="json", by_alias=True)
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


@pytest.mark.parametrize("path", PRIORS, ids=name_of)
def test_no_shipped_config_is_a_variant_an_ablation_or_draws_near_copies(path):
    config = load_config(str(path))
    assert config.distribution in ("paper", "sampler")
    model = config.model
    assert config.stage_names[:2] in (("layout", "shape"), ("shape",), ("shape", "sampler"))
    assert config.method == "lifted" or config.layout is not None, "one stage is ablation c3"
    assert model.completeness_target == "first_n"
    names = (model.latent_space.name, model.decoder.name, model.layout_heads)
    assert names == ("sphere", "transformer", "joint")
    decoder = model.decoder
    assert not (decoder.final_norm or decoder.query_self_attention or decoder.step_mlps)


def test_the_released_codes_settings_are_one_command_away():
    """The keys that docs/paper_map.md lists, as it lists them."""
    text = (FOLDER.parent / "docs" / "paper_map.md").read_text()
    _, command = text.split("```bash\n", 1)
    words = command.split("```", 1)[0].replace("\\\n", " ").split()
    assert words[:4] == ["sceneprior", "fit", "--config", "paper/bedroom.yaml"]
    config = load_config(words[3], tuple(words[i + 1] for i, w in enumerate(words) if w == "--set"))
    model = config.model
    decoder = model.decoder
    assert (decoder.hidden, model.layout_heads, model.completeness_target) == (
        512, "separate", "stop",
    )  # fmt: skip
    assert decoder.final_norm and decoder.query_self_attention and decoder.step_mlps
    assert (config.layout.batch_size, config.layout.schedule.milestones) == (128, (400,))
    assert (config.shape.batch_size, config.shape.schedule.milestones) == (16, (300,))
    assert config.sampling.distribution == "paper"


def test_a_config_from_before_methods_had_names_is_a_sentence(config):
    replaced(config, "method: paper", "stages: two")
    assert refusal(config).startswith(f"{config} was written before methods had names")


def test_a_former_section_that_asks_for_nothing_is_dropped(config):
    for former in ("{every: 0, count: 200, seed: 0, metric: category_kl}", "{count: 5}", "{}"):
        assert load_config(str(config), (f"samples={former}",)) == load_config(str(config))
    assert refusal(config, "samples={every: 25}") == (
        f"{config} with samples={{every: 25}}: 'samples.every' is 25, but training no longer "
        "evaluates generated rooms; delete the section `samples`. The run's final.ckpt is read as "
        "before."
    )
    data = yaml.safe_load(config.read_text()) | {"samples": {"every": 0}}
    with pytest.raises(ConfigError, match="unknown key 'samples'"):
        check_settings(PaperConfig, data, "a")


def test_keys_of_another_method_are_refused(config):
    assert "unknown key 'sampler'" in refusal(config, "sampler={epochs: 2}")
    assert "unknown key 'loss.occlusion_slack'" in refusal("demo.yaml", "loss.occlusion_slack=1")
    assert "unknown key 'training'; the" in refusal(config, "training.epochs=3")


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


def test_no_such_config_lists_the_shipped_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ", ".join(sorted(name_of(path) for path in FOLDER.rglob("*.yaml")))
    assert refusal("nowhere.yaml") == (
        f"No config 'nowhere.yaml': it is neither a file nor one of the shipped {names}."
    )
    assert "No config 'sub/demo.yaml'" in refusal("sub/demo.yaml")


@pytest.mark.parametrize(
    ("old", "new", "key", "near"),
    [
        ("  width: 16", "  widht: 16", "model.widht", "model.width"),
        ("loss: {}", "loss: {clas: 1.0}", "loss.clas", "loss.class"),
        ("label_set:", "labelset: x\nlabel_set:", "labelset", "label_set"),
    ],
)
def test_a_typo_names_the_key_the_file_and_the_nearest_key(config, old, new, key, near):
    assert refusal(replaced(config, old, new)) == (
        f"{config}: unknown key '{key}'; the nearest valid key is '{near}'."
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("  width: 16", "  width: wide",
         "'model.width': input should be a valid integer (got 'wide')."),
        ("    fit_box: true", "    fit_box: 1",
         "'model.shape.fit_box': input should be a valid boolean (got 1)."),
        ("  epochs: 6", "  epochs: 0",
         "'layout.epochs': input should be greater than or equal to 1 (got 0)."),
        ("    heads: 2", "    heads: 3", "'model': width 16 is not a multiple of heads 3."),
        ("  epochs: 6\n", "", "'layout.epochs' is missing and has no default; add it."),
        ("label_set: front3d_bedroom", "label_set: attic",
         f"label_set: No label set is called 'attic'; there are {', '.join(LABEL_SETS)}, or write "
         "your own as void,bed,chair."),
        ("label_set: front3d_bedroom", "label_set: 'void,bed,bed'",
         "label_set: The class 'bed' is in the label set twice"),
        ("loss: {}", "loss: 3", "'loss': input should be a valid dictionary or instance of"),
    ],
)  # fmt: skip
def test_a_wrong_value_says_what_came_and_what_was_expected(config, old, new, said):
    message = refusal(replaced(config, old, new))
    assert message.startswith(f"{config}: {said}")


def test_several_mistakes_are_counted(config):
    replaced(config, "  width: 16", "  widht: 16")
    replaced(config, "  epochs: 6", "  epochs: 0")
    assert "more problem" in refusal(config)


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


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("data.shard=mine",
         " with data.shard=mine: unknown key 'data.shard'; the nearest valid key is 'data.shards'"
         "."),
        ("model.width", "--set takes section.key=value, got 'model.width'."),
        ("model.width.deep=3", "--set model.width.deep=3: 'width' is a value, not a section."),
        ("model.width=[", "--set model.width=[: '[' is not a YAML value."),
        ("model.decoder={name: lstm, step_mlps: true}",
         ": unknown key 'model.decoder.step_mlps'; the nearest valid key is 'model.decoder.name'."),
        ("model.decoder={name: gru}",
         ": no name of 'model.decoder' is 'gru'; choose from transformer, lstm, atiss2d."),
        ("model.decoder=lstm", ": 'model.decoder' is a section; write {name: ...} with one of "
         "transformer, lstm, atiss2d."),
        ("model.latent_space={anchors: 4}",
         ": 'model.latent_space' has no name; add one of sphere, cube."),
        ("method=nerf", f": no method is called 'nerf'; choose from {', '.join(METHODS)}."),
        ("method=[a]", f": no method is called '['a']'; choose from {', '.join(METHODS)}."),
        ("method=ours", " was written when `method: ours` stood for two methods; they are now "
         "`paper` and `lifted`, each with its own sections. Train it again with a current config."),
    ],
)  # fmt: skip
def test_an_override_that_cannot_be_is_a_sentence(config, override, said):
    assert refusal(config, override).endswith(said)


@pytest.mark.parametrize("text", ["", "just words", "- a\n- list\n", "a: [1,\n", "\tx: 1\n"])
def test_a_file_that_is_no_config_is_a_sentence(tmp_path, text):
    path = tmp_path / "odd.yaml"
    path.write_text(text)
    message = refusal(path)
    assert message.startswith(f"{path} ")
    assert "holds no settings; expected" in message or "is not a YAML file: " in message
    path.write_bytes(b"\xff\xfe\x00")
    assert "is not a YAML file" in refusal(path)


def _laughs(levels: int) -> str:
    """Ten times ten times ... a word, by aliases."""
    lines = ["a: &a [ha, ha, ha, ha, ha, ha, ha, ha, ha, ha]"]
    names = "abcdefghijklm"[:levels]
    for before, name in pairwise(names):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (_laughs(9) + "label_set: *i", "it has more than 20,000 values"),
        ("x: " + "[" * 3000 + "]" * 3000, "it has more than 30 sections within each other"),
        ("x: " + "{a: " * 3000 + "1" + "}" * 3000, "it has more than 30 sections within"),
        ("x: &x [*x]", "it has an alias that stands for a part of itself"),
        ("x: 2001-99-99", "month must be in 1..12"),
        ("seed: " + "9" * 5000, "Exceeds the limit (4300 digits)"),
        ("#" * 2**20 + "\nx: 1", "it has more than 1,048,576 bytes"),
    ],
    ids=["laughs", "lists", "sections", "self", "date", "digits", "bytes"],
)
def test_yaml_that_would_fill_the_memory_or_the_stack_is_refused(config, text, said):
    config.write_text(text)
    assert refusal(config).startswith(f"{config} is not a YAML file: {said}")
    if len(text) < 2000:
        assert "is not a YAML value." in refusal(FOLDER / "demo.yaml", f"seed={{{text}}}")


def test_long_values_are_abbreviated(config):
    for old, new in (
        ("seed: 3", f"seed: [{'ab' * 9000}]"),
        ("seed: 3", f"seed: '{'ab' * 9000}'"),
        ("seed: 3", f"{'ab' * 500}: 3"),
        ("label_set: front3d_bedroom", f"label_set: {'ab' * 9000}"),
        ("method: paper", f"method: {'ab' * 9000}"),
    ):
        text = config.read_text()
        message = refusal(replaced(config, old, new))
        assert 50 < len(message) < 900 and "ab" in message
        config.write_text(text)
    assert "input should be less than" in refusal(config, "seed=4294967296")
