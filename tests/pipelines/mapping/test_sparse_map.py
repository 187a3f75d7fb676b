"""The sparse map's books: stable ids, rows used again, covisibility, local points, culling."""

from pathlib import Path

import numpy as np
import pytest

from pipelines.config import MappingConfig
from pipelines.geometry import backproject, exp_se3, make_T, project_stereo, transform_points
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Features, StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 50.0)
COLUMNS = ("position_m", "covariance_m2", "offset_slope", "descriptor", "color")


def new_map(**settings):
    return SparseMap(CAMERA, MappingConfig(**settings))


def random_points(n, seed=0):
    """Rows for `add_points` in view of a camera at the origin."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([20, 20], [620, 460], (n, 2))
    A = 0.01 * rng.normal(size=(n, 3, 3))
    return (
        backproject(CAMERA, uv, rng.uniform(4, 30, n)),
        A @ A.transpose(0, 2, 1),
        rng.normal(size=(n, 3)),
        rng.integers(0, 256, (n, 32)).astype(np.uint8),
        rng.integers(0, 256, (n, 3)).astype(np.uint8),
    )


def tracks_of(ids):
    n = len(ids)
    return Tracks(np.asarray(ids, np.int64), np.ones((n, 2)), np.full(n, 5.0), np.full(n, 0.3))


def keyframe_of(ids, frame_index=0, z=0.0):
    T = make_T(np.eye(3), np.array([0.0, 0.0, z]))
    return Keyframe(frame_index, 0.1 * frame_index, T, tracks_of(ids), Features.empty())


NOTHING = np.empty(0, np.int64)


def test_points_are_stored_under_their_ids():
    sparse_map = new_map()
    rows = [random_points(n, seed=n) for n in (5, 0, 12)]
    ids = [sparse_map.add_points(*r) for r in rows]
    assert len(np.unique(np.concatenate(ids))) == 17
    for found, stored in zip(ids, rows, strict=True):
        for name, values in zip(COLUMNS, stored, strict=True):
            np.testing.assert_array_equal(getattr(sparse_map, name)[found], values, err_msg=name)
        assert sparse_map.alive[found].all()
        assert (sparse_map.n_found[found] == 1).all() and (sparse_map.n_visible[found] == 1).all()
    assert sparse_map.alive.sum() == 17


def test_ids_stay_while_the_map_grows():
    sparse_map = new_map()
    rows = [random_points(3000, seed=k) for k in range(5)]
    ids = [sparse_map.add_points(*r) for r in rows]
    assert sparse_map.alive.sum() == 15000
    assert len(np.unique(np.concatenate(ids))) == 15000
    for found, stored in zip(ids, rows, strict=True):
        for name, values in zip(COLUMNS, stored, strict=True):
            np.testing.assert_array_equal(getattr(sparse_map, name)[found], values, err_msg=name)


def test_rows_are_used_again_only_where_no_keyframe_saw_the_point():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(100))
    seen = ids[:40]
    sparse_map.add_keyframe(keyframe_of(seen))
    sparse_map.cull_points(NOTHING, NOTHING)  # the young sixty die
    assert sparse_map.alive[ids].tolist() == [True] * 40 + [False] * 60
    again = sparse_map.add_points(*random_points(80, seed=1))
    assert np.isin(again, ids[40:]).sum() == 60
    assert not np.isin(again, seen).any()
    assert len(np.unique(again)) == 80
    assert sparse_map.alive.sum() == 120
    assert (sparse_map.n_found[again] == 1).all() and (sparse_map.n_keyframes[again] == 0).all()
    assert (sparse_map.n_keyframes[seen] == 1).all()


def test_a_row_is_not_given_out_twice():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(30))
    for _ in range(3):
        sparse_map.cull_points(ids[:10], NOTHING)
    a = sparse_map.add_points(*random_points(15, seed=1))
    b = sparse_map.add_points(*random_points(15, seed=2))
    assert len(np.unique(np.concatenate([ids[:10], a, b]))) == 40


def test_memory_stays_flat_when_young_points_come_and_go():
    sparse_map = new_map()
    for k in range(60):
        sparse_map.add_points(*random_points(500, seed=k))
        sparse_map.cull_points(NOTHING, NOTHING)
    assert len(sparse_map.alive) < 10000
    assert sparse_map.alive.sum() == 0


def see(sparse_map, ids, found_ids, times):
    for _ in range(times):
        sparse_map.record_sight(ids, found_ids)


def test_sights_are_counted_once_per_frame():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(4))
    visible = np.concatenate([ids[:3], ids[:2]])  # the same point from two lists
    see(sparse_map, visible, ids[:2], 3)
    assert sparse_map.n_visible[ids].tolist() == [4, 4, 4, 1]
    assert sparse_map.n_found[ids].tolist() == [4, 4, 1, 1]


def test_points_rarely_found_where_visible_are_culled():
    sparse_map = new_map(min_found_ratio=0.25)
    ids = sparse_map.add_points(*random_points(60))
    sparse_map.add_keyframe(keyframe_of(ids))
    often, rarely, new = ids[:20], ids[20:40], ids[40:]
    see(sparse_map, ids[:40], often, 20)
    see(sparse_map, new, NOTHING, 3)  # too few chances to judge
    sparse_map.cull_points(NOTHING, ids)
    assert sparse_map.alive[often].all() and sparse_map.alive[new].all()
    assert not sparse_map.alive[rarely].any()
    fresh = sparse_map.add_points(*random_points(60, seed=1))
    assert not np.isin(fresh, ids).any()  # the keyframe still names the dead ones


def test_a_tracked_point_is_not_culled():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(20))
    see(sparse_map, ids, NOTHING, 50)
    sparse_map.cull_points(ids[:5], ids)
    assert sparse_map.alive[ids].tolist() == [True] * 5 + [False] * 15


def test_points_that_are_no_numbers_are_culled_always():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(6))
    sparse_map.add_keyframe(keyframe_of(ids))
    sparse_map.position_m[ids[0], 1] = np.nan
    sparse_map.position_m[ids[1], 2] = np.inf
    sparse_map.cull_points(ids, NOTHING)
    assert sparse_map.alive[ids].tolist() == [False, False] + [True] * 4


def test_covisibility_is_symmetric_and_needs_enough_points():
    sparse_map = new_map(min_shared_points=15)
    ids = sparse_map.add_points(*random_points(200))
    sees = [ids[:100], ids[60:160], ids[86:200], ids[:15], ids[190:200]]
    for k, seen in enumerate(sees):
        sparse_map.add_keyframe(keyframe_of(seen, frame_index=k))
    for k, a in enumerate(sees):
        shared = [len(np.intersect1d(a, b)) for b in sees]
        expected = {m for m, n in enumerate(shared) if n >= 15 and m != k}
        assert set(sparse_map.covisible_keyframes(k).tolist()) == expected
    assert {len(sparse_map.covisible_keyframes(k)) for k in range(5)} == {0, 1, 2}
    counts = sum(np.isin(ids, seen) for seen in sees)
    np.testing.assert_array_equal(sparse_map.n_keyframes[ids], counts)


def test_the_latest_keyframe_lists_its_best_neighbour_first():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(120))
    for k, seen in enumerate((ids[:50], ids[:90], ids[:70], ids)):
        sparse_map.add_keyframe(keyframe_of(seen, frame_index=k))
    assert sparse_map.covisible_keyframes(3).tolist() == [1, 2, 0]


def test_a_point_remembers_its_first_keyframe():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(60))
    sparse_map.add_keyframe(keyframe_of(ids[:40]))
    sparse_map.add_keyframe(keyframe_of(ids[20:], frame_index=1))
    assert sparse_map.first_keyframe[ids].tolist() == [0] * 40 + [1] * 20


def test_local_points_are_in_view_alive_and_not_tracked():
    sparse_map = new_map()
    points, *rest = random_points(300)
    points[:40, 2] *= -1  # behind the camera
    points[40:60, 0] += 60  # beside the picture
    ids = sparse_map.add_points(points, *rest)
    sparse_map.add_keyframe(keyframe_of(ids[:280]))
    sparse_map.cull_points(ids[:270], NOTHING)  # the last twenty were never in a keyframe
    tracked = ids[100:150]
    found, uv = sparse_map.local_points(np.eye(4), tracked)
    np.testing.assert_array_equal(np.sort(found), np.r_[ids[60:100], ids[150:280]])
    expected = project_stereo(CAMERA, sparse_map.position_m[found])[:, :2]
    np.testing.assert_allclose(uv, expected)


def test_local_points_follow_the_camera():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(300))
    sparse_map.add_keyframe(keyframe_of(ids))
    T = exp_se3(np.array([0.0, 0.15, 0.0, 0.2, 0.0, 0.3]))
    found, uv = sparse_map.local_points(T, ids[:10])
    assert 50 < len(found) < 290
    assert ((uv > 0) & (uv < [639, 479])).all()
    back = transform_points(np.linalg.inv(T), sparse_map.position_m[found])
    np.testing.assert_allclose(uv, project_stereo(CAMERA, back)[:, :2], atol=1e-9)


def test_local_points_of_an_empty_map():
    found, uv = new_map().local_points(np.eye(4), NOTHING)
    assert len(found) == 0 and uv.shape == (0, 2)


def test_places_passed_before_join_the_local_map():
    """Tracked points name only the near keyframes, but the camera stands where it once was."""
    sparse_map = new_map(local_keyframes=2, near_keyframe_baselines=8.0)
    points, *rest = random_points(80)
    old = sparse_map.add_points(points, *rest)
    sparse_map.add_keyframe(keyframe_of(old))
    for k in range(1, 12):
        far = sparse_map.add_points(np.add(points, [0, 0, 10.0 * k]), *rest)
        sparse_map.add_keyframe(keyframe_of(far, frame_index=k, z=10.0 * k))
    here, _ = sparse_map.local_points(make_T(np.eye(3), np.array([0.1, 0, 0])), far)
    assert np.isin(old, here).mean() > 0.8
    turned_away = exp_se3(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert not np.isin(old, sparse_map.local_points(turned_away, far)[0]).any()


def test_observations_are_of_the_tracked_points():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(9))
    tracks = tracks_of(ids[[7, 2]])
    observations = sparse_map.observe(tracks, 0.7)
    np.testing.assert_array_equal(observations.points_world_m, sparse_map.position_m[ids[[7, 2]]])
    np.testing.assert_array_equal(
        observations.point_covariances_m2, sparse_map.covariance_m2[ids[[7, 2]]]
    )
    np.testing.assert_array_equal(observations.uvr_px, tracks.uvr_px)
    assert observations.sigma_disparity_px.tolist() == [0.7, 0.7]


def test_a_new_disparity_offset_moves_points_along_their_slopes():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(20))
    before = sparse_map.position_m[ids].copy()
    slopes = sparse_map.offset_slope[ids].copy()
    sparse_map.shift_offset(ids[:15], 0.2)
    moved = before + 0.2 * slopes
    moved[15:] = before[15:]
    np.testing.assert_allclose(sparse_map.position_m[ids], moved)
    np.testing.assert_array_equal(sparse_map.offset_slope[ids], slopes)


def snapshot_scene():
    """Ten well-measured points, and ten each with one thing wanting."""
    sparse_map = new_map(min_observations=3, max_relative_depth_sigma=0.1)
    points, covariances, *rest = random_points(50)
    covariances[:] = 1e-4 * np.eye(3)
    distance = np.linalg.norm(points, axis=1)
    covariances[10:20] = (0.2 * distance[10:20])[:, None, None] ** 2 * np.eye(3)  # too vague
    ids = sparse_map.add_points(points, covariances, *rest)
    sparse_map.add_keyframe(keyframe_of(ids[:40], frame_index=4))
    seldom, dead = ids[20:30], ids[30:40]
    see(sparse_map, np.setdiff1d(ids, seldom), np.setdiff1d(ids, seldom), 2)
    sparse_map.alive[dead] = False
    return sparse_map, ids


def test_snapshot_holds_the_well_measured_points():
    sparse_map, ids = snapshot_scene()
    static_map = sparse_map.snapshot()
    np.testing.assert_array_equal(static_map.points_m, sparse_map.position_m[ids[:10]])
    np.testing.assert_array_equal(static_map.colors, sparse_map.color[ids[:10]])
    assert static_map.n_observations.tolist() == [3] * 10
    assert static_map.keyframe_indices.tolist() == [4]
    np.testing.assert_array_equal(static_map.keyframe_Ts_world_camera, np.eye(4)[None])


def test_snapshot_is_a_copy():
    sparse_map, _ = snapshot_scene()
    static_map = sparse_map.snapshot()
    before = static_map.points_m.copy()
    sparse_map.position_m += 5.0
    sparse_map.keyframes[0].T_world_camera[0, 3] = 9.0
    np.testing.assert_array_equal(static_map.points_m, before)
    assert static_map.keyframe_Ts_world_camera[0, 0, 3] == 0.0


@pytest.mark.parametrize("with_points", [False, True])
def test_snapshot_before_the_first_keyframe_is_empty(with_points):
    sparse_map = new_map()
    if with_points:
        sparse_map.add_points(*random_points(10))
    static_map = sparse_map.snapshot()
    assert len(static_map) == 0
    assert static_map.keyframe_Ts_world_camera.shape == (0, 4, 4)


def test_covisible_keyframes_are_most_shared_first_for_older_ones_too():
    sparse_map = new_map()
    ids = sparse_map.add_points(*random_points(120))
    for k, seen in enumerate((ids, ids[:20], ids[:90])):
        sparse_map.add_keyframe(keyframe_of(seen, frame_index=k))
    assert sparse_map.covisible_keyframes(0).tolist() == [2, 1]


@pytest.mark.parametrize("name", ["mapping/sparse_map", "mapping/keyframe", "observations"])
def test_what_the_front_end_reads_of_the_map_does_not_know_the_front_end(name):
    source = Path(__file__).parents[3] / "pipelines" / f"{name}.py"
    imported = [line for line in source.read_text().splitlines() if "import" in line]
    assert len(imported) > 2
    assert not [line for line in imported if "pipelines.frontend" in line]
