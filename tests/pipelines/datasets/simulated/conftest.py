"""Small simulated sequences, rendered once for all tests of this folder, and KITTI-like labels."""

import numpy as np
import pytest

from pipelines.datasets.simulated import SimulatedSequence

SMALL = {"street": 0.3, "crossing": 0.3, "room": 0.35}


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("simulated")


@pytest.fixture(scope="session", params=["street", "room"])
def exact(request, cache):
    """Four exact frames with everything provided."""
    return SimulatedSequence(
        request.param,
        frames=4,
        scale=SMALL[request.param],
        provide=("depth", "flow", "masks", "right"),
        cache=cache,
    )


@pytest.fixture(scope="session")
def street(cache):
    return SimulatedSequence("street", frames=4, scale=SMALL["street"], cache=cache)


@pytest.fixture(scope="session")
def crossing(cache):
    """Three exact frames; the camera stands still in them."""
    return SimulatedSequence("crossing", frames=3, scale=SMALL["crossing"], cache=cache)


@pytest.fixture(scope="session")
def stuck_in_walls():
    """A function (world, frames) -> labels of moving actors that something still reaches into.

    Rays run along the sides and diagonals of each box, above the kerb and at two thirds of its
    height; a body that stands free has nothing on them.
    """
    import open3d as o3d

    def find(world, frames):
        scene = o3d.t.geometry.RaycastingScene()
        vertices = o3d.core.Tensor(world.static.vertices.astype(np.float32))
        scene.add_triangles(vertices, o3d.core.Tensor(world.static.triangles.astype(np.uint32)))
        stuck = set()
        for actor in world.actors:
            if not actor.moving:
                continue
            low, high = actor.mesh.bounds()
            corners = np.array([(x, 0, z) for x in (low[0], high[0]) for z in (low[2], high[2])])
            pairs = np.array([(0, 1), (1, 3), (3, 2), (2, 0), (0, 3), (1, 2)])
            for k in frames:
                if not actor.is_present(k):
                    continue
                T = actor.Ts_scene_object[k]
                for share in (0.2, 0.66):
                    corners[:, 1] = high[1] - share * (high[1] - low[1])
                    p = corners @ T[:3, :3].T + T[:3, 3]
                    start, way = p[pairs[:, 0]], p[pairs[:, 1]] - p[pairs[:, 0]]
                    rays = np.concatenate([start, way], 1).astype(np.float32)
                    hits = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
                    if (hits < 1).any():
                        stuck.add(actor.object_id)
        return stuck

    return find


def write_kitti_labels(folder):
    """KITTI tracking's three files of a made-up sequence 0004 in their folder.

    The ego car drives 8 m/s along z and pitches. Track 0 parks on the right, 1 drives ahead at
    9 m/s and bears to the right, 2 walks at 1.3 m/s on the left, 3 is a tram that stands far off,
    4 is seen twice only, 5 leaves after frame 9; everything jitters as labels do.
    """
    rng = np.random.default_rng(5)
    for name in ("label_02", "calib", "orbslam3_poses/0004"):
        (folder / name).mkdir(parents=True)
    P2 = "721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884"
    P3 = "721.5377 0 609.5593 -339.5242 0 721.5377 172.854 2.199936 0 0 1 0.002729905"
    (folder / "calib/0004.txt").write_text(f"P2: {P2}\nP3: {P3}\n")
    N, poses, rows = 40, [], []
    for k in range(N):
        t, p = k / 10, 0.01 * np.sin(k)
        tilt = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
        poses.append(np.column_stack([tilt, (0, 0, 8 * t / 0.97)]).ravel())
        turn = 0.02 * t**2
        things = [
            (0, "Car", (1.5, 1.8, 4.2), (4.0, 30.0), 0.0),
            (1, "Van", (2.0, 1.9, 4.8), (9 * t * turn / 3, 20 + 9 * t), turn),
            (2, "Pedestrian", (1.7, 0.6, 0.8), (-8.5, 25 + 1.3 * t), 0.0),
            (3, "Tram", (3.4, 2.4, 14.0), (20.0, 70.0), 0.4),
            (4, "Car", (1.5, 1.8, 4.2), (-6.0, 40.0), 0.0),
            (5, "Cyclist", (1.7, 0.6, 1.8), (-3.5, 28 - 4 * t), np.pi),
            (-1, "DontCare", (-1, -1, -1), (0.0, 0.0), 0.0),
        ]
        for track, kind, hwl, (x, z), heading in things:
            if (track == 4 and k > 1) or (track == 5 and k > 9):
                continue
            place = (x, z - 8 * t) + 0.04 * rng.standard_normal(2)
            ry = heading - np.pi / 2 + 0.02 * rng.standard_normal()
            words = [*hwl, place[0], 1.7, place[1], ry]
            rows.append(f"{k} {track} {kind} 0 0 0 1 1 9 9 " + " ".join(map(str, words)))
    np.savetxt(folder / "orbslam3_poses/0004/CameraTrajectory.txt", poses)
    (folder / "label_02/0004.txt").write_text("\n".join(rows) + "\n")


@pytest.fixture
def kitti_labels(tmp_path):
    """Folder of a made-up KITTI sequence 0004, free to be damaged."""
    write_kitti_labels(tmp_path / "kitti")
    return tmp_path / "kitti"


@pytest.fixture(scope="session")
def replayed(cache, tmp_path_factory):
    """22 small frames of that sequence."""
    folder = tmp_path_factory.mktemp("kitti")
    write_kitti_labels(folder)
    return SimulatedSequence(
        "simulated:kitti_0004", labels=folder, cache=cache, frames=22, scale=0.15
    )
