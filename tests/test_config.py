"""Configs: every shipped one loads, and every mistake is a sentence that names its place."""

from pathlib import Path

import pytest
from tiny_runs import write_tiny_config

from sceneprior.classes import LABEL_SETS
from sceneprior.config import dump_config, find_config, load_config
from sceneprior.errors import ConfigError, InputError

FOLDER = Path(__file__).parents[1] / "configs"
SHIPPED = sorted(FOLDER.glob("*.yaml"))


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


def test_the_demo_and_the_papers_settings_are_there():
    assert {"demo.yaml", "bedroom.yaml", "living.yaml"} <= {path.name for path in SHIPPED}


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_configs_load_and_survive_being_saved(path, tmp_path):
    config = load_config(str(path))
    dump_config(config, tmp_path / "saved.yaml")
    assert load_config(str(tmp_path / "saved.yaml")) == config


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_shipped_configs_are_complete(path):
    """No setting is left to a default, so that a diff of two files shows how two runs differ."""
    import yaml

    def keys(data, prefix=""):
        for key, value in data.items():
            yield from keys(value, f"{prefix}{key}.") if isinstance(value, dict) else [prefix + key]

    everything = load_config(str(path)).model_dump(mode="json", by_alias=True)
    assert set(keys(yaml.safe_load(path.read_text()))) == set(keys(everything))


@pytest.mark.parametrize(("name", "objects"), [("bedroom", 13), ("living", 28)])
def test_the_papers_numbers(name, objects):
    config = load_config(f"{name}.yaml")
    model = config.model
    assert (model.max_objects, model.width, model.heads, model.hidden) == (objects, 512, 4, 1024)
    assert (config.data.views_per_room, config.data.mask_step) == (20, 4)
    loss = config.loss
    assert (loss.match_box, loss.iou_gate, loss.hidden_overshoot) == (5.0, 0.5, 1.0)
    assert config.layout.proxy == "ellipsoid" and config.shape.compositing == "paper"
    assert (model.template, model.fit_box, model.shape_level) == ("sphere", False, 4)


def test_a_shipped_config_is_found_by_name_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_config("demo.yaml").samefile(FOLDER / "demo.yaml")
    assert load_config("demo.yaml").label_set == "front3d_bedroom"
    # A file of that name here comes first.
    write_tiny_config(tmp_path / "demo.yaml", Path("mine"))
    assert load_config("demo.yaml").data.shards == "mine"


def test_no_such_config_lists_the_shipped_ones(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ", ".join(path.name for path in SHIPPED)
    assert refusal("nowhere.yaml") == (
        f"No config 'nowhere.yaml': it is neither a file nor one of the shipped {names}."
    )
    assert "No config 'sub/demo.yaml'" in refusal("sub/demo.yaml")


@pytest.mark.parametrize(
    ("old", "new", "key", "near"),
    [
        ("  width: 16", "  widht: 16", "model.widht", "width"),
        ("  batch_size: 5", "  batchsize: 5", "layout.batchsize", "batch_size"),
        ("loss: {}", "loss: {clas: 1.0}", "loss.clas", "class"),
        ("label_set:", "labelset: x\nlabel_set:", "labelset", "label_set"),
        ("  compositing: layered", "  composting: layered", "shape.composting", "compositing"),
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
        ("  width: 16", "  width: 16.5",
         "'model.width': input should be a valid integer (got 16.5)."),
        ("  fit_box: true", "  fit_box: 1",
         "'model.fit_box': input should be a valid boolean (got 1)."),
        ("  epochs: 6", "  epochs: 0",
         "'layout.epochs': input should be greater than or equal to 1 (got 0)."),
        ("  template: box", "  template: cone",
         "'model.template': input should be 'sphere' or 'box' (got 'cone')."),
        ("  heads: 2", "  heads: 3", "'model': width 16 is not a multiple of heads 3."),
        ("  epochs: 6\n", "", "'layout.epochs' is missing and has no default; add it."),
        ("label_set: front3d_bedroom", "label_set: attic",
         f"label_set: No label set is called 'attic'; there are {', '.join(LABEL_SETS)}, or write "
         "your own as void,bed,chair."),
        ("label_set: front3d_bedroom", "label_set: 'void,bed,bed'",
         "label_set: The class 'bed' is twice in the label set"),
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
        ("model.width=32", "loss.class=0.5", "shape.sigma_px2=null", "layout.milestones=[1, 2]",
         "data.shards=elsewhere", "layout.learning_rate=1e-2"),
    )  # fmt: skip
    assert (loaded.model.width, loaded.loss.class_, loaded.shape.sigma_px2) == (32, 0.5, None)
    assert loaded.layout.milestones == (1, 2) and loaded.data.shards == "elsewhere"
    assert loaded.layout.learning_rate == 0.01
    plain = load_config(str(config))
    assert plain.model.width == 16


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("model.width", "--set takes section.key=value, got 'model.width'."),
        ("model.width.deep=3", "--set model.width.deep=3: 'width' is a value, not a section."),
        ("model.widht=3", "unknown key 'model.widht'; the nearest valid key is 'width'."),
        ("modle.width=3", "unknown key 'modle'; the nearest valid key is 'model'."),
        ("model.width=wide", "'model.width': input should be a valid integer (got 'wide')."),
        ("model.width=[", "--set model.width=[: '[' is not a YAML value."),
    ],
)
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


def test_a_config_cannot_be_changed_and_is_an_input_error(config):
    loaded = load_config(str(config))
    with pytest.raises(Exception, match="frozen"):
        loaded.model.width = 3
    assert issubclass(ConfigError, InputError)
