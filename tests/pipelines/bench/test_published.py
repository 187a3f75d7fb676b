"""Figures of others: copied rightly, and found for the sequences that they are of, no others."""

from __future__ import annotations

import pytest

from pipelines.bench.measures import FRAME_TIME, MEASURES
from pipelines.bench.published import published_for


def by_system(dataset: str, name: str) -> dict[str, dict[str, float]]:
    return {entry.system: entry.values for entry in published_for(dataset, name)}


def test_kitti_tracking_in_each_of_its_layouts() -> None:
    found = by_system("kitti_tracking", "0018")
    assert found["VDO-SLAM"] == {
        "ate_m": 9.94, "rpe_trans_m": 0.09, "rpe_rot_deg": 0.03,
        "motion_trans_m": 0.16, "motion_rot_deg": 0.36,
    }  # fmt: skip
    assert found["DynoSAM (WCME)"]["motion_rot_deg"] == 0.60
    assert found["DynaSLAM II"] == {"ate_m": 1.09, "rpe_trans_m": 0.05, "rpe_rot_deg": 0.02}
    assert by_system("vdo", "kitti_tracking_0003_vdo_format_10f") == by_system(
        "kitti_tracking", "0003"
    )
    rendered = published_for("simulated", "kitti_0004-degraded")
    assert rendered[0].values["ate_m"] == 1.42 and "rendered" in rendered[0].source
    assert {entry.frames for entry in rendered} == {314}


def test_peers_that_ran_on_the_same_files() -> None:
    vdo = by_system("vdo", "drive_deg")["VDO-SLAM"]
    assert (vdo["motion_trans_m"], vdo["motion_rot_deg"], vdo["speed_kmh"]) == (0.0175, 0.18, 0.32)
    assert (vdo["coverage_share"], vdo["false_movers"]) == (0.84, 59)
    assert by_system("vdo", "room")["ORB-SLAM3, no masks"]["rpe_rot_deg"] == 0.24
    kitchen = by_system("tum_rgbd", "7scenes_redkitchen_200f")["ORB-SLAM3"]
    assert (kitchen["ate_m"], kitchen["rpe_trans_m"]) == (0.053, 0.011)


def test_odometry_and_rgbd() -> None:
    assert by_system("kitti_odometry", "01")["DynaSLAM"] == {
        "t_rel_percent": 1.57, "r_rel_deg": 0.22, "ate_m": 9.4,
    }  # fmt: skip
    cut = by_system("kitti_odometry", "kitti_odom06_000-050_stereo")
    assert cut["ORB-SLAM3"]["ate_m"] == 0.035 and cut["ORB-SLAM2"]["ate_m"] == 0.8
    walking = by_system("tum_rgbd", "rgbd_dataset_freiburg3_walking_xyz")
    assert walking == {"ORB-SLAM2": {"ate_m": 0.459}, "DynaSLAM": {"ate_m": 0.015}}
    box = by_system("tum_rgbd", "rgbd_bonn_moving_nonobstructing_box")
    assert box["DynaSLAM"] == {"ate_m": 0.232}


@pytest.mark.parametrize(
    ("dataset", "name"),
    [
        ("simulated", "room"),  # a scene of ours, not the generated sequence
        ("simulated", "street-degraded"),
        ("folder", "0003"),
        ("vdo", "kitti-0000-0013"),
        ("kitti_tracking", "0007"),
        ("kitti_odometry", "2011_09_26"),
        ("tum_rgbd", "rgbd_dataset_freiburg1_desk"),
    ],
)
def test_other_sequences_have_none(dataset: str, name: str) -> None:
    assert published_for(dataset, name) == []


def test_every_figure_has_a_column() -> None:
    keys = {measure.key for measure in (*MEASURES, FRAME_TIME)}
    names = [("kitti_tracking", "0000"), ("kitti_odometry", "06"), ("vdo", "drive_deg")]
    for dataset, name in names:
        entries = published_for(dataset, name)
        assert entries
        for entry in entries:
            assert set(entry.values) <= keys and entry.source
