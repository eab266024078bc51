"""Reading configurations: precedence, refusals, resolution."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import pytest
from configuration_page import PAGE, count, page, tables
from pydantic import ValidationError

from hybridmap.config import Config, gone, named_configs
from hybridmap.config.section import value_of
from hybridmap.errors import ConfigError

BEFORE = Path(__file__).with_name("config_before.yaml")


def test_overrides_win_over_the_file_which_wins_over_defaults(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("nodes: {distance_m: 0.7, angle_deg: 11}\n")
    config = Config.load(path, {"nodes.distance_m": 0.9})
    assert (config.nodes.distance_m, config.nodes.angle_deg) == (0.9, 11)
    assert config.nodes.rule == Config().nodes.rule


def test_a_file_extends_another_beside_it_or_by_name(tmp_path):
    (tmp_path / "base.yaml").write_text("nodes: {distance_m: 0.7}\nseed: 3\n")
    (tmp_path / "top.yaml").write_text("extends: base.yaml\nnodes: {angle_deg: 5}\n")
    config = Config.load(tmp_path / "top.yaml")
    assert (config.seed, config.nodes.distance_m, config.nodes.angle_deg) == (3, 0.7, 5)


def test_extending_in_a_circle_is_refused(tmp_path):
    (tmp_path / "a.yaml").write_text("extends: b.yaml\n")
    (tmp_path / "b.yaml").write_text("extends: a.yaml\n")
    with pytest.raises(ConfigError, match="forms a cycle"):
        Config.load(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("nodes: {distanse_m: 1}\n", r"unknown key 'nodes.distanse_m'; did you mean 'distance_m'\?"),
        ("xyz: 1\n", r"unknown key 'xyz'; expected one of seed, "),
        ("nodes: {distance_m: -1}\n", r"nodes.distance_m: .*greater than 0, found -1"),
        ("nodes: {distance_m: .nan}\n", r"nodes.distance_m: .*finite"),
        ("nodes: [1]\n", r"nodes: expected keys with values, found \[1\]"),
        ("seed: -1\n", r"seed: expected a number greater than or equal to 0, found -1"),
        (
            "vision: {closing: {by: ratslam}}\n",
            r"yaml: vision.closing.by is ratslam: expected edges.hanging ratslam, found chain",
        ),
        (
            "vision: {sensor: none}\nnodes: {rule: views}\n",
            r"yaml: nodes.rule is views: expected a vision.sensor, which makes the nodes, found none",
        ),
        (
            "extends: ratslam\nvision: {sensor: none}\n",
            r"yaml: nodes.rule is views: expected a vision.sensor, which makes the nodes, found none",
        ),
        (
            "extends: laser\nnodes: {rule: views}\n",
            r"yaml: nodes.rule is views: of a laser it needs vision.laser.scan.templates true, found false",
        ),
        (
            "neural: {modules: 0}\nnodes: {rule: novelty}\n",
            r"nodes.rule: expected travel or views where neural.modules is 0 \(no place code\), found novelty",
        ),
        (
            "vision: {closing: {by: proximity}, rgbd: {verify: none}}\n",
            r"yaml: vision: expected vision.rgbd.verify pnp where vision.closing.by is proximity",
        ),
        (
            "extends: ratslam\nvision: {matching: {c_t: 0}}\n",
            r"yaml: vision: expected vision.matching.c_t above 0 where vision.closing.by is ratslam, found 0",
        ),
        ("backends: {names: []}\n", r"backends.names: expected at least 1 of them, found \[\]"),
        ("backends: {names: x}\n", r"backends.names: expected a list, found 'x'"),
        ("backends: {names: [a, b, a]}\n", r"backends.names: expected each back-end once, found 'a' again"),
        ("- 1\n", r"expected a mapping"),
        ("a: [\n", r"not YAML: line 2: "),
    ],
)
def test_refusals_name_the_key(tmp_path, text, expected):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=expected):
        Config.load(path)


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("laser", {"vision.laser.scan.templates": True}),
        ("ratslam", {"vision.sensor": "laser", "vision.laser.scan.templates": False}),
        ("bionic-laser", {}),
        ("rgbd", {"vision.laser.scan.templates": False}),
        ("rgbd", {"neural.modules": 0}),
    ],
)
def test_views_make_nodes_wherever_there_are_some(name, overrides):
    assert Config.load(name, overrides | {"nodes.rule": "views"}).nodes.rule == "views"


def test_a_refusal_names_the_file_or_who_overrode_it(tmp_path):
    (tmp_path / "a.yaml").write_text("seed: 3\n")
    with pytest.raises(ConfigError, match=r"^command line: seed: .*found -1"):
        Config.load(tmp_path / "a.yaml", {"seed": -1})
    (tmp_path / "a.yaml").write_text("seed: -1\n")
    with pytest.raises(ConfigError, match=r"^\S+a.yaml: seed: .*found -1"):
        Config.load(tmp_path / "a.yaml", {"nodes.distance_m": -2})
    assert Config.load(tmp_path / "a.yaml", {"seed": 2}).seed == 2


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("simulation.wheels.slip_m", 0.1, "it is the constant SLIP_M in hybridmap/simulation/motion.py"),
        ("neural.dtype", "float32", "every population has double precision"),
        ("vision.laser.probes", {"points": 3}, "it is the constant POINTS in hybridmap/vision/laser/hypotheses.py"),
        ("vision.laser.tracking", {"narrow": {"half_m": 3}}, "it is the constant NARROW in hybridmap/vision/laser/tracking.py"),
    ],
)
def test_a_setting_that_has_gone_says_what_became_of_it(key, value, said):
    with pytest.raises(ConfigError, match=rf"^command line: {key}(\.\w+)? is no longer a setting: {said}$"):
        Config.load(None, {key: value})


@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("vision.laser.tracking.narrow.half_m", 3, "NARROW"),
        ("vision.laser.commitment", {}, "WAIT_M"),
        ("vision.laser.commitment", 3, "WAIT_M"),
        ("vision.laser.commitment", {"none_such": 3}, "WAIT_M"),
    ],
)
def test_what_lies_below_or_above_a_setting_that_has_gone_says_so_too(key, value, named):
    with pytest.raises(ConfigError, match=named):
        Config.load(None, {key: value})


def test_a_key_that_is_there_twice_is_refused(tmp_path):
    (tmp_path / "a.yaml").write_text("nodes:\n  distance_m: 1\nseed: 2\nnodes: {angle_deg: 5}\n")
    with pytest.raises(ConfigError, match=r"^\S+a.yaml: .*line 4: .*'nodes'"):
        Config.load(tmp_path / "a.yaml")


def test_all_settings_that_have_gone_are_named_at_once():
    with pytest.raises(ConfigError, match=r"^\S+: 162 keys are no longer settings") as error:
        Config.load(BEFORE)
    assert {"vision.laser.tracking", "neural.dtype", "calibration.every_m"} <= {*re.findall(r"[\w.]+", str(error.value))}


def test_a_setting_that_was_renamed_says_its_new_name():
    with pytest.raises(ConfigError, match=r"vision\.laser\.retrace\.enabled is now called vision\.laser\.dense_trajectory$"):
        Config.load(None, {"vision.laser.retrace.enabled": False})
    assert not Config.stored("vision: {laser: {retrace: {enabled: false}}}", "session").vision.laser.dense_trajectory


def test_what_became_of_a_setting_is_true():
    current = {setting.key for table in tables() for setting in table.settings}
    for key, (module, name) in gone.constants().items():
        assert key not in current
        assert hasattr(importlib.import_module(f"hybridmap.{module.removesuffix('.py').replace('/', '.')}"), name), key
    assert not current & (gone.RENAMED.keys() | gone.OTHERWISE.keys())
    assert {*gone.RENAMED.values()} <= current


def test_a_stored_configuration_is_read_without_what_has_gone():
    old = "nodes: {distance_m: 0.4}\nneural: {dtype: float64, gain: 1.5, place: {theta_hz: 7.5}}\n"
    assert Config.stored(old, "session") == Config.load(None, {"nodes.distance_m": 0.4, "neural.gain": 1.5})
    assert Config.stored(BEFORE.read_text(), "session") == Config.load(None, {"sensors.odometry_delay_s": 0.0})


def test_the_page_of_settings_is_current():
    assert PAGE.read_text(encoding="utf-8") == page(), "write it anew: python tools/configuration_page.py"


def test_there_are_few_settings_and_none_lies_deep():
    assert count(Config().model_dump()) <= 110
    assert max(setting.key.count(".") for table in tables() for setting in table.settings) <= 3


def test_every_setting_says_what_it_does_and_in_which_unit():
    for table in tables():
        for setting in table.settings:
            assert setting.does.endswith("."), setting.key
            assert setting.unit or not setting.type.startswith(("number", "integer")), setting.key


def test_a_missing_configuration_lists_the_names():
    with pytest.raises(ConfigError, match="rgbd"):
        Config.load("no-such-thing")


def test_sections_are_frozen():
    with pytest.raises(ValidationError):
        Config().seed = 3


@pytest.mark.parametrize("name", sorted(named_configs()))
def test_every_named_configuration_loads_and_its_resolved_form_is_itself(name, tmp_path):
    config = Config.load(name)
    (tmp_path / "resolved.yaml").write_text(config.to_yaml())
    assert Config.load(tmp_path / "resolved.yaml") == config


@pytest.mark.parametrize(
    "text",
    [
        "[" * 3000,
        "{a: " * 3000 + "1" + "}" * 3000,
        "- " * 3000,
        "a: &a [*a]",
        "a: &a [1,1,1,1,1,1,1,1,1,1]\n" + "".join(f"x{i}: &{chr(98 + i)} [{f'*{chr(97 + i)},' * 10}]\n" for i in range(9)),
        "9" * 6000,
        "2001-99-99",
        "!!timestamp x",
        "!!bool x",
        "? [a]\n: 1",
        "!!python/object:os.system x",
        "a: 1\n" * 2_500_000,
    ],
    ids=lambda text: text[:20],
)
def test_a_document_that_no_reader_should_take_is_refused_at_once(text):
    with pytest.raises(ConfigError) as caught:
        value_of(text, "here")
    assert len(str(caught.value)) < 300
    assert str(caught.value).startswith("here: ")


@pytest.mark.parametrize(
    "key", ["backends.max_iterations", "nodes.distance_m", "sensors.sync_tolerance_s", "vision.rgbd.max_width_px"]
)
def test_a_setting_of_a_billion_is_refused_before_anything_is_made_of_it(key):
    with pytest.raises(ConfigError, match=key.replace(".", r"\.")):
        Config.load(None, {key: 10**9})


def test_a_mounting_without_rotation_and_a_lens_of_three_numbers_are_refused():
    for quaternion, said in (([0, 0, 0, 0], "length 0$"), ([0, 0, 0, 5000], "found length 5000; divide it by its length")):
        with pytest.raises(ConfigError, match=said):
            Config.load(None, {"sensors.camera_mounting": {"translation_m": [0, 0, 0], "quaternion_xyzw": quaternion}})
    intrinsics = {"width_px": 8, "height_px": 6, "fx_px": 5, "fy_px": 5, "cx_px": 4, "cy_px": 3, "distortion": [0.1, 0.2, 0.3]}
    with pytest.raises(ConfigError, match="distortion"):
        Config.load(None, {"sensors.camera_intrinsics": intrinsics})


def test_a_long_chain_of_files_is_refused(tmp_path):
    for k in range(200):
        (tmp_path / f"{k}.yaml").write_text(f"extends: {k + 1}.yaml")
    with pytest.raises(ConfigError, match="chain of more than"):
        Config.load(tmp_path / "0.yaml")
