"""TUM RGB-D folders."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from hybridmap.config import Config
from hybridmap.config.inputs import SensorsConfig
from hybridmap.errors import StreamError
from hybridmap.streams import open_stream
from hybridmap.streams.base import SelfMotion
from hybridmap.streams.rgbd import RgbdFrame
from tests.narrowing import as_a, known
from tests.streams.recordings import NS, color_pixels, depth_mm

CAMERA = """
camera: {width: 8, height: 6, fx: 10.0, fy: 10.5, cx: 3.5, cy: 2.5, distortion: [0, 0, 0, 0, 0], depth_scale: 5000.0}
base_to_camera: {translation: [0.1, 0.0, 0.5], quaternion_xyzw: [-0.5, 0.5, -0.5, 0.5]}
"""


@pytest.fixture
def folder(tmp_path):
    """Three frames, six odometry lines."""
    for name in ("rgb", "depth"):
        (tmp_path / name).mkdir()
    rgb, depth = ["# colour"], ["# depth"]
    for i in range(3):
        stamp = f"{100 + i / 10:.6f}"
        cv2.imwrite(str(tmp_path / f"rgb/{i}.png"), color_pixels(i)[..., ::-1])
        cv2.imwrite(str(tmp_path / f"depth/{i}.png"), depth_mm(i))
        rgb.append(f"{stamp} rgb/{i}.png")
        depth.append(f"{100 + i / 10 + 0.004:.6f} depth/{i}.png")
    (tmp_path / "rgb.txt").write_text("\n".join(rgb))
    (tmp_path / "depth.txt").write_text("\n".join(depth))
    (tmp_path / "camera.yaml").write_text(CAMERA)
    (tmp_path / "odometry.txt").write_text("".join(f"{100 + i / 20} {i / 10} 0 0 0 0 0 1\n" for i in range(6)))
    return tmp_path


def _config(**sensors) -> Config:
    return Config(sensors=SensorsConfig(**sensors))


def _frames(stream):
    return [sample for sample in stream if isinstance(sample, RgbdFrame)]


def test_frames_and_odometry_in_order(folder):
    stream = open_stream(folder, Config())
    for _ in range(2):
        samples = list(stream)
        stamps = [sample.stamp_ns for sample in samples]
        assert stamps == sorted(stamps)
        assert isinstance(samples[0], SelfMotion)
        frames = [sample for sample in samples if isinstance(sample, RgbdFrame)]
        assert [frame.stamp_ns for frame in frames] == [100 * NS, 100 * NS + NS // 10, 100 * NS + NS // 5]
        for i, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.color, color_pixels(i))
            np.testing.assert_array_equal(frame.depth_m, (depth_mm(i) / 5000.0).astype(np.float32))
    assert stream.report.counts == {"odometry": 6, "frames": 3, "unmatched color": 0, "unmatched depth": 0}
    camera = stream.rig.sensors["camera"]
    assert (camera.width_px, camera.height_px, camera.fy_px) == (8, 6, 10.5)
    np.testing.assert_allclose(camera.T_base_camera[:3, 3], [0.1, 0.0, 0.5])
    assert stream.expected_observations == 3


@pytest.mark.parametrize("depth_first", [False, True])
def test_associations_win_over_the_lists(folder, depth_first):
    color, depth = "100.2 rgb/2.png", "100.204 depth/0.png"
    (folder / "associations.txt").write_text(f"{depth} {color}\n" if depth_first else f"{color} {depth}\n")
    (frame,) = _frames(open_stream(folder, Config()))
    assert frame.stamp_ns == 100 * NS + NS // 5
    np.testing.assert_array_equal(frame.color, color_pixels(2))
    np.testing.assert_array_equal(frame.depth_m, (depth_mm(0) / 5000.0).astype(np.float32))


def test_pictures_without_partner_are_counted(folder):
    with (folder / "rgb.txt").open("a") as file:
        file.write("\n100.25 rgb/0.png\n")
    stream = open_stream(folder, Config())
    assert len(_frames(stream)) == 3
    assert stream.report.counts["unmatched color"] == 1


def test_odometry_is_named_by_the_configuration(folder):
    (folder / "odometry_hard.txt").write_text("100 9 0 0 0 0 0 1\n101 9 0 0 0 0 0 1\n")
    stream = open_stream(folder, _config(odometry_file="odometry_hard.txt"))
    first = as_a(SelfMotion, next(iter(stream)))
    assert first.pose_odom_robot[0] == 9.0


def test_only_the_part_between_start_and_end(folder):
    stream = open_stream(folder, Config(), start_s=0.1, end_s=0.15)
    assert [type(sample) for sample in stream] == [SelfMotion, RgbdFrame, SelfMotion]


def test_truth_of_the_camera_is_carried_to_the_base(folder):
    half = 0.5**0.5
    # The optical axis along +y, at (2, 3): a base turned by 90 deg whose camera sits 0.1 m ahead.
    (folder / "groundtruth.txt").write_text(f"100 2 3 0.5 {-half} 0 0 {half}\n")
    np.testing.assert_allclose(known(open_stream(folder, Config()).groundtruth).poses, [[2.0, 2.9, np.pi / 2]], atol=1e-12)
    (folder / "groundtruth_base.txt").write_text("100 7 8 0 0 0 0 1\n")
    np.testing.assert_array_equal(known(open_stream(folder, Config()).groundtruth).poses, [[7, 8, 0]])


def test_calibration_of_the_configuration_stands_in_for_camera_yaml(folder):
    (folder / "camera.yaml").unlink()
    config = _config(
        camera_intrinsics={"width_px": 8, "height_px": 6, "fx_px": 10, "fy_px": 11, "cx_px": 3.5, "cy_px": 2.5},
        camera_mounting={"translation_m": [0.0, 0.0, 0.4]},
        depth_scale=1000.0,
    )
    stream = open_stream(folder, config)
    assert stream.rig.sensors["camera"].fy_px == 11
    np.testing.assert_allclose(stream.rig.sensors["camera"].T_base_camera[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)
    np.testing.assert_array_equal(_frames(stream)[0].depth_m, (depth_mm(0) / 1000.0).astype(np.float32))


def _remove(name):
    return lambda folder: (folder / name).unlink()


def _write(name, text):
    return lambda folder: (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (_remove("odometry.txt"), ["odometry.txt", "wheel odometry of base_link"]),
        (lambda f: (f / "odometry.txt").rename(f / "odom_b.txt"), ["odom_b.txt", "sensors.odometry_file"]),
        (_remove("camera.yaml"), ["camera.yaml", "sensors.camera_intrinsics"]),
        (_write("camera.yaml", "camera: {width: 8}\nbase_to_camera: {translation: [0, 0, 0]}"), ["camera.yaml", "height"]),
        (_write("camera.yaml", CAMERA.split("base_to")[0]), ["base_to_camera", "sensors.camera_mounting"]),
        (_write("camera.yaml", "camera: ["), ["camera.yaml", "YAML"]),
        (_write("camera.yaml", CAMERA.replace("width: 8", "width: 16")), ["8x6", "16x6"]),
        (_remove("rgb/1.png"), ["rgb/1.png", "no such picture"]),
        (_write("depth/1.png", "no picture"), ["depth/1.png", "cannot be decoded"]),
        (lambda f: cv2.imwrite(str(f / "depth/1.png"), np.zeros((3, 4), np.uint16)), ["depth/1.png", "4x3", "8x6"]),
        (lambda f: cv2.imwrite(str(f / "depth/1.png"), color_pixels()), ["depth/1.png", "16 bit"]),
        (_remove("depth.txt"), ["depth.txt"]),
        (_write("rgb.txt", "100 rgb/0.png\nx rgb/1.png"), ["rgb.txt:2", "stamp"]),
        (_write("rgb.txt", "100\n"), ["rgb.txt:1", "2 fields"]),
        (_write("rgb.txt", "# nothing"), ["rgb.txt", "no picture"]),
        (_write("rgb.txt", "300 rgb/0.png"), ["sync_tolerance_s"]),
        (_write("odometry.txt", "100 nan 0 0 0 0 0 1\n"), ["odometry.txt:1", "NaN"]),
        (_write("odometry.txt", "100 0 0 0 0 0 0 1\n99 0 0 0 0 0 0 1\n"), ["odometry.txt:2", "goes back"]),
    ],
)  # fmt: skip
def test_a_damaged_folder_is_refused(folder, damage, words):
    damage(folder)
    with pytest.raises(StreamError) as caught:
        list(open_stream(folder, Config()))
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.data
def test_a_real_office_gives_what_its_readme_says(data_dir):
    stream = open_stream(data_dir / "real/hololens_office", Config(), end_s=4.0)
    frames = _frames(stream)
    whole = open_stream(data_dir / "real/hololens_office", Config())
    assert whole.expected_observations == 373
    assert len(known(whole.groundtruth)) == 373
    assert frames[0].color.shape == (180, 270, 3)
    valid = np.mean([(frame.depth_m > 0).mean() for frame in frames])
    assert 0.5 < valid < 0.75
    assert max(frame.depth_m.max() for frame in frames) < 7.5


def test_damaged_and_missing_pictures_are_skipped_and_counted_on_request(folder):
    (folder / "depth/0.png").write_text("no picture")
    (folder / "rgb/2.png").unlink()
    stream = open_stream(folder, Config(), skip_damaged=True)
    assert len(_frames(stream)) == 1
    assert stream.report.lost == {"rgb.txt": (2, 3)}
    assert [said.split(": ")[1] for said in stream.report.skips] == ["depth/0.png", "rgb/2.png"]
    (folder / "rgb/1.png").unlink()
    with pytest.raises(StreamError, match="none of its 3 pictures"):
        open_stream(folder, Config(), skip_damaged=True)
