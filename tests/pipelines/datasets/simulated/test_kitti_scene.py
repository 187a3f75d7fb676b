"""Replayed KITTI sequences: made-up labels in the published form, and the real ones."""

import numpy as np
import pytest

from pipelines.datasets.simulated import SimulatedSequence
from pipelines.datasets.simulated.kitti_labels import EGO_SCALE, KittiFiles
from pipelines.datasets.simulated.kitti_motion import (
    PERSONS,
    ego_path,
    outline,
    overlapping,
    read_tracks,
)
from pipelines.datasets.simulated.kitti_scene import make_kitti
from pipelines.datasets.simulated.road_users import cyclist_mesh, fitted, lorry_mesh, tram_mesh
from pipelines.datasets.simulated.scenes import find_scene, scaled_camera
from pipelines.errors import ConfigError, DatasetError

REAL = "kitti_tracking_gt_all21"


@pytest.fixture
def tracks(kitti_labels):
    labels = KittiFiles.find("0004", kitti_labels).read()
    return {track.track: track for track in read_tracks(labels, 39)}


def test_camera_and_ego_path_are_the_files(kitti_labels):
    labels = KittiFiles.find("0004", kitti_labels).read()
    assert labels.camera.fx == 721.5377
    assert labels.camera.bf == pytest.approx(44.85728 + 339.5242)
    Ts = ego_path(labels, 39)
    assert Ts.shape == (40, 4, 4)
    assert np.diff(Ts[:, 2, 3]) == pytest.approx(0.8, abs=0.01)
    assert -Ts[:, 1, 3] == pytest.approx(1.7, abs=0.05)
    assert 0.003 < np.ptp(Ts[:, 1, 2]) < 0.04  # its quick pitch is kept
    assert np.linalg.det(Ts[:, :3, :3]) == pytest.approx(1, abs=1e-9)


def test_what_is_no_thing_or_hardly_seen_is_left_out(tracks):
    assert sorted(tracks) == [0, 1, 2, 3, 5]


def test_parked_things_stand_where_their_labels_are_on_average(tracks):
    car = tracks[0]
    assert not car.moving
    assert np.ptp(car.x_m) == np.ptp(car.z_m) == np.ptp(car.heading_rad) == 0
    assert (car.x_m[0], car.z_m[0]) == pytest.approx((4.0 + 0.06, 30.0), abs=0.03)
    assert 1e-6 < abs(car.heading_rad[0]) < 0.02
    assert car.present.all()


def test_moving_things_follow_their_labels_smoothly(tracks):
    van, t = tracks[1], np.arange(40) / 10
    assert van.moving
    error = np.hypot(van.x_m - 0.06 - 9 * t * 0.02 * t**2 / 3, van.z_m - 20 - 9 * t)
    assert 0.003 < error.max() < 0.2
    accelerations = np.diff(np.stack([van.x_m, van.z_m]), 2) * 100
    assert np.abs(accelerations).max() < 4  # raw labels: above 10
    walker = tracks[2]
    assert np.diff(walker.z_m) * 10 == pytest.approx(1.3, abs=0.25)


def test_no_wheel_slides_sideways(tracks):
    for track in (tracks[1], tracks[5]):
        arm = 0.3 * track.size_m[2]
        x = track.x_m - arm * np.sin(track.heading_rad)
        z = track.z_m - arm * np.cos(track.heading_rad)
        middle = (track.heading_rad[1:] + track.heading_rad[:-1]) / 2
        across = np.diff(x) * np.cos(middle) - np.diff(z) * np.sin(middle)
        assert np.abs(across * 10).max() < 0.08
        assert np.hypot(np.diff(x), np.diff(z)).min() * 10 > 3


def test_things_are_there_a_little_longer_than_their_labels(tracks):
    cyclist = tracks[5]
    assert cyclist.labelled.sum() == 10
    assert cyclist.present[:20].all()
    assert not cyclist.present[20:].any()
    assert np.diff(cyclist.z_m, 2)[11:] == pytest.approx(0, abs=1e-9)  # straight on


def test_rectangles_that_overlap_are_told_from_those_that_do_not():
    def square(x, yaw=0.0):
        return outline(np.array(x), np.array(0.0), np.array(yaw), 2.0, 2.0)

    assert overlapping(square(0.0), square(1.9))
    assert not overlapping(square(0.0), square(2.1))
    assert overlapping(square(0.0), square(2.1), 0.2)
    assert overlapping(square(0.0), square(2.3, np.pi / 4))
    assert not overlapping(square(0.0), square(2.5, np.pi / 4))


def test_the_world_stands_on_its_ground_and_apart(kitti_labels, stuck_in_walls):
    files = KittiFiles.find("0004", kitti_labels)
    world = make_kitti(files, 39, 0, files.read().camera)
    names = {a.object_id: a.class_name for a in world.actors}
    assert names == {1: "car", 2: "car", 3: "person", 4: "train", 6: "bicycle"}
    for actor in world.actors:
        _, high = actor.mesh.bounds()
        assert actor.Ts_scene_object[:, 1, 3] + high[1] == pytest.approx(0, abs=1e-9)
    assert world.actors[1].mesh.bounds()[1] * 2 == pytest.approx((1.9, 2.0, 4.8), abs=1e-9)
    assert stuck_in_walls(world, range(40)) == set()
    assert len(world.static) > 10_000


def test_frames_and_truth(replayed):
    frame, truth = replayed.read(1), replayed.ground_truth()
    assert np.isfinite(frame.depth_m[replayed.camera.height // 2 + 4 :]).all()
    seen = set(np.unique(frame.instance_labels)) - {0}
    assert {1, 2} <= seen
    assert set(frame.instance_classes) == seen
    assert frame.instance_classes[2] == "car"
    assert truth.Ts_world_camera[2][2, 3] == pytest.approx(1.6, abs=0.03)
    assert set(truth.objects.object_id[truth.objects.moving]) == {2, 3, 6}


def test_absent_objects_have_neither_pixels_nor_rows(replayed):
    objects = replayed.ground_truth().objects
    assert objects.frame_index[objects.object_id == 6].tolist() == list(range(20))
    assert len(objects) == 22 * 4 + 20
    assert all(6 not in replayed.read(k).instance_labels for k in (20, 21))
    assert any(6 in replayed.read(k).instance_labels for k in range(20))
    for k in (20, 21):  # the flow out of its last frames is there, and that of its motion
        flow = replayed.read(k).flow_prev_to_curr_px
        assert np.abs(flow[np.isfinite(flow)]).max() < 2 * replayed.camera.width


def test_rendered_frames_are_kept_by_what_the_labels_say(kitti_labels, tmp_path, monkeypatch):
    monkeypatch.setattr(SimulatedSequence, "_render_left", lambda self, folder: None)
    options = {"labels": kitti_labels, "cache": tmp_path / "cache", "frames": 1}
    roots = [SimulatedSequence("kitti_0004", **options).root for _ in range(2)]
    for file, old, new in (
        ("label_02/0004.txt", "Van", "Car"),
        ("calib/0004.txt", "44.85728", "44.9"),
        ("orbslam3_poses/0004/CameraTrajectory.txt", "e+00", "e+01"),
    ):
        path = kitti_labels / file
        path.write_text(path.read_text().replace(old, new, 1))
        roots.append(SimulatedSequence("kitti_0004", **options).root)
    assert len(set(roots)) == 4
    assert roots[0] == roots[1]


def test_the_folder_may_be_named_by_the_environment(kitti_labels, monkeypatch):
    monkeypatch.setenv("DYOB_KITTI_TRACKING", str(kitti_labels))
    scene = find_scene("kitti_0004")
    assert (scene.frames, scene.fps, scene.camera.width) == (40, 10.0, 1242)


def test_without_labels_it_says_how_to_give_them(tmp_path, monkeypatch):
    monkeypatch.delenv("DYOB_KITTI_TRACKING", raising=False)
    with pytest.raises(DatasetError, match=r"set DYOB_KITTI_TRACKING .* label_02/0004\.txt, calib"):
        SimulatedSequence("kitti_0004")
    (tmp_path / "label_02").mkdir()
    (tmp_path / "label_02/0004.txt").write_text("")
    with pytest.raises(DatasetError, match=r"found no calib/0004\.txt and no orbslam3_poses"):
        SimulatedSequence("kitti_0004", labels=tmp_path)


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("label_02/0004.txt", "0 0 Car 1 2\n", "expected 17 columns"),
        ("label_02/0004.txt", "0 0 Car" + " x" * 14 + "\n", "expected 17 columns"),
        ("calib/0004.txt", "P2: 1 2 3\n", "expected 12 numbers after P2"),
        ("calib/0004.txt", "P0: 1\n", "expected lines P2: and P3:"),
        ("orbslam3_poses/0004/CameraTrajectory.txt", "1 2\n3 4\n5 6\n", "12 finite numbers"),
    ],
)
def test_damaged_files_are_named(kitti_labels, file, content, words):
    (kitti_labels / file).write_text(content)
    with pytest.raises(DatasetError, match=words) as error:
        find_scene("kitti_0004", kitti_labels)
    assert str(kitti_labels / file) in str(error.value)


def test_more_frames_than_there_are_is_refused(kitti_labels, tmp_path):
    with pytest.raises(ConfigError, match="has 40 frames, found frames=41"):
        SimulatedSequence("kitti_0004", labels=kitti_labels, frames=41, cache=tmp_path)


@pytest.mark.parametrize("name", ["kitti_0021", "kitti_4", "kitti_"])
def test_other_numbers_are_no_scene(name):
    with pytest.raises(DatasetError, match="kitti_0000 to kitti_0020"):
        find_scene(name)


def test_shapes_become_as_large_as_asked():
    from pipelines.datasets.simulated.people import WARDROBE

    for mesh in (lorry_mesh(), tram_mesh(), cyclist_mesh(WARDROBE[0])):
        low, high = fitted(mesh, np.array([1.0, 2.0, 5.0])).bounds()
        assert high == pytest.approx((0.5, 1.0, 2.5))
        assert low == pytest.approx((-0.5, -1.0, -2.5))
        assert np.linalg.norm(mesh.normals, axis=-1) == pytest.approx(1, abs=1e-9)


@pytest.mark.parametrize("name", ["0000", "0003", "0004", "0012", "0018", "0020"])
def test_real_traffic_moves_like_matter(real_data, name):
    labels = KittiFiles.find(name, real_data(REAL)).read()
    n = min(150, len(labels.Ts_world_camera))
    tracks = read_tracks(labels, n)
    assert len(tracks) >= 4
    for track in tracks:
        x, z = track.x_m[track.present], track.z_m[track.present]
        v = np.stack([np.diff(x), np.diff(z)]) * 10
        assert np.hypot(*v).max(initial=0) < 40
        assert np.hypot(*np.diff(v)).max(initial=0) * 10 < 9
        if track.moving and track.kind not in PERSONS:
            arm = 0.3 * track.size_m[2]
            psi = track.heading_rad
            ax, az = track.x_m - arm * np.sin(psi), track.z_m - arm * np.cos(psi)
            mid = (psi[1:] + psi[:-1]) / 2
            across = np.diff(ax) * np.cos(mid) - np.diff(az) * np.sin(mid)
            assert np.abs(across[track.present[1:]] * 10).max() < 0.15
    for i, a in enumerate(tracks):
        for b in tracks[:i]:
            both = a.present & b.present
            assert not overlapping(a.outlines_m[both], b.outlines_m[both], -0.3).any()


def test_real_ego_path_keeps_its_length(real_data):
    labels = KittiFiles.find("0004", real_data(REAL)).read()
    Ts = ego_path(labels, 150)
    length = np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1).sum()
    rough = np.loadtxt(real_data(REAL) / "orbslam3_poses/0004/CameraTrajectory.txt")[:151, 3::4]
    given = np.linalg.norm(np.diff(rough, axis=0), axis=1).sum() * EGO_SCALE
    assert length == pytest.approx(given, rel=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["0000", "0003", "0004", "0012", "0018", "0020"])
def test_real_traffic_passes_through_nothing(real_data, stuck_in_walls, name):
    files = KittiFiles.find(name, real_data(REAL))
    camera = scaled_camera(files.read().camera, 0.1)
    world = make_kitti(files, find_scene(f"kitti_{name}", real_data(REAL)).frames, 0, camera)
    assert stuck_in_walls(world, range(0, world.n_frames, 3)) == set()
