"""What solved motions do to their objects: to filter, pose and state, and the row that tells them.

Owns what is believed of a motion: fused with the one expected, doubted where hardly any point bears
it out, and left untold where it is too uncertain. Solves nothing; rules of states and filters are
in the modules beside this one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.config import ObjectsConfig
from pipelines.frontend.view import View
from pipelines.geometry import backproject, rotation_vector, transform_points
from pipelines.object_types import ObjectState
from pipelines.objects.frame import LastObjects, ObjectFrame
from pipelines.objects.kalman import direction_std
from pipelines.objects.motion import (
    GATE_6DOF,
    displacement,
    fuse_motions,
    largest_std,
    motion_in_world,
    world_covariance,
)
from pipelines.objects.motion_state import decide_by_scene_flow, decide_by_speed
from pipelines.objects.rows import RowTable
from pipelines.objects.solver import Solution
from pipelines.objects.track import ObjectTrack
from pipelines.types import Array, StereoCamera

_SURE_SHARE = 0.6  # of the points that must agree with a motion that nobody expected
_LASTING_SHARE = 0.5  # of a speed's error stays from frame to frame, as its points do


@dataclass(frozen=True, slots=True)
class _Believed:
    """One motion in the world, as it is believed.

    row: of the solution. H_world_curr_prev: (4, 4) with covariance (6, 6), as of
    `world_covariance`. center_m: (3,) after the motion, way_m: (3,) that it went. spread_m: root
    mean square distance of its points from their middle. turn_std_radps: of its rotation.
    """

    row: int
    H_world_curr_prev: Array
    covariance: Array
    center_m: Array
    way_m: Array
    spread_m: float
    turn_std_radps: float


class MotionIntake:
    """Takes the motions of one frame, of which `last` is the frame before."""

    def __init__(
        self,
        camera: StereoCamera,
        config: ObjectsConfig,
        last: LastObjects,
        view: View,
        T_world_camera: Array,
        pose_covariance: Array,
    ) -> None:
        self.camera, self.config, self._last, self._view = camera, config, last, view
        self._T_world_camera, self._pose_covariance = T_world_camera, pose_covariance
        self._dt_s = view.timestamp_s - last.view.timestamp_s

    def take(
        self,
        solution: Solution,
        tracks: Mapping[int, ObjectTrack],
        frame: ObjectFrame,
        table: RowTable,
    ) -> list[int]:
        """Believed motions into tracks and table; the ids of the objects that have one."""
        taken = []
        for motion in self._believe(solution, tracks):
            track = tracks[int(solution.motions.object_id[motion.row])]
            self._tell(solution, motion, track, frame.scores[track.object_id], table)
            taken.append(track.object_id)
        return taken

    def _believe(self, solution: Solution, tracks: Mapping[int, ObjectTrack]) -> list[_Believed]:
        """The accepted motions that are to be believed and certain enough to be told."""
        config, dt_s, motions = self.config, self._dt_s, solution.motions
        rows = np.flatnonzero(solution.accepted)
        if len(rows) == 0:
            return []
        those = [tracks[int(i)] for i in motions.object_id[rows]]
        middles, spreads = (part[rows] for part in _middles(solution))
        T_prev = self._last.T_world_camera
        middles = transform_points(T_prev, middles)  # of the points, where there is no box yet
        boxes = [track.box_center_m for track in those]
        centers = np.stack([m if c is None else c for c, m in zip(boxes, middles, strict=True)])
        Hs = motion_in_world(motions.Gs_curr_prev[rows], self._T_world_camera, T_prev)
        covariances = world_covariance(
            motions.covariances[rows] + self._pose_covariance,
            self._T_world_camera,
            centers + displacement(Hs, centers),
        )
        expected = [t.expected_motion(c, dt_s) for t, c in zip(those, centers, strict=True)]
        fused = fuse_motions(
            np.stack([H for H, _ in expected]),
            np.stack([covariance for _, covariance in expected]),
            Hs,
            covariances,
            centers,
        )
        n_agree = motions.n_inliers[rows]
        sure = n_agree >= np.maximum(_SURE_SHARE * motions.n_points[rows], 2 * config.min_points)
        known = np.array([track.H_world_curr_prev is not None for track in those])
        # Nothing moves like that, or hardly any point says so
        doubted = (fused.distance2 > GATE_6DOF) & ~(known & sure)
        ways = displacement(fused.H_world_curr_prev, centers)
        turn_std, way_std = (
            largest_std(fused.covariance[:, part, part]) for part in (slice(0, 3), slice(3, 6))
        )
        # No wild estimates go out
        certain = turn_std <= np.radians(config.max_turn_std_deg)
        certain &= np.hypot(way_std, turn_std * spreads) <= config.max_speed_std_mps * dt_s
        return [
            _Believed(
                int(rows[i]),
                fused.H_world_curr_prev[i],
                fused.covariance[i],
                centers[i] + ways[i],
                ways[i],
                float(spreads[i]),
                float(turn_std[i]) / dt_s,
            )
            for i in np.flatnonzero(certain & ~doubted)
        ]

    def _tell(
        self,
        solution: Solution,
        motion: _Believed,
        track: ObjectTrack,
        score: float,
        table: RowTable,
    ) -> None:
        """One motion into its track's filter, pose and state, and as a row."""
        dt_s, covariance = self._dt_s, motion.covariance
        std_mps = direction_std(motion.way_m, covariance[3:, 3:]) / dt_s
        is_first = not track.has_motion
        track.take_motion(motion.H_world_curr_prev, covariance, motion.center_m, dt_s)
        if self.config.motion_rule == "scene_flow":
            state = decide_by_scene_flow(self.config, self._scene_flow(solution, motion.row))
        else:
            state = self._state_by_speed(track, motion, std_mps)
        track.set_state(state, self._view.timestamp_s)
        if is_first and state is ObjectState.MOVING:
            track.orient()
        if self._is_too_far(solution, motion.row):
            table.add(track, score, center_m=motion.center_m, state=ObjectState.UNKNOWN)
            return
        table.add(
            track,
            score,
            n_points=int(solution.motions.n_inliers[motion.row]),
            H_world_curr_prev=motion.H_world_curr_prev,
            motion_covariance=covariance,
            center_m=motion.center_m,
            speed_mps=float(np.linalg.norm(motion.way_m)) / dt_s,  # eq. (6)
            speed_std_mps=float(np.hypot(std_mps, track.middle_doubt_mps(self._sure_turn(motion)))),
        )

    def _sure_turn(self, motion: _Believed) -> float:
        """The speed of turning in rad/s, less its standard deviation."""
        turn = float(np.linalg.norm(rotation_vector(motion.H_world_curr_prev))) / self._dt_s
        return max(0.0, turn - motion.turn_std_radps)

    def _state_by_speed(self, track: ObjectTrack, motion: _Believed, std_mps: float) -> ObjectState:
        """State by the speed of the object's points: of its centre, and of its sure turning."""
        assert track.filter is not None
        turn = float(np.linalg.norm(track.filter.turn_radps))
        sure_turn = max(0.0, turn - self.config.significance * motion.turn_std_radps)
        speed = float(np.linalg.norm(track.filter.velocity_mps)) + sure_turn * motion.spread_m
        std = float(np.hypot(track.filter.speed_std_mps, _LASTING_SHARE * std_mps))
        return decide_by_speed(self.config, track.state, speed, std)

    def _is_too_far(self, solution: Solution, row: int) -> bool:
        """Whether an object is beyond the depth up to which motions are told, if there is one."""
        if self.config.max_depth_m <= 0.0:
            return False
        agreeing = _agreeing(solution, row)
        depth_m = float(np.median(solution.points.position_m[agreeing, 2]))
        return depth_m > self.config.max_depth_m

    def _scene_flow(self, solution: Solution, row: int) -> Array:
        """f = X_k p_k - X_k-1 p_k-1 (N, 3) in m, of the points whose depth is measured now."""
        agreeing = _agreeing(solution, row)
        uvr = solution.observations.uvr_px[agreeing]
        z = self.camera.bf / (uvr[:, 0] - uvr[:, 2])
        known = np.isfinite(z)
        now = backproject(self.camera, uvr[known, :2], z[known])
        positions = solution.points.position_m[agreeing][known]
        before = transform_points(self._last.T_world_camera, positions)
        return transform_points(self._T_world_camera, now) - before


def _agreeing(solution: Solution, row: int) -> NDArray[np.int64]:
    """Rows of the points that agree with the motion of one object."""
    rows = solution.rows_of(row)
    return rows[solution.motions.inliers[rows]]


def _middles(solution: Solution) -> tuple[Array, Array]:
    """Middles (J, 3) of each object's agreeing points, in the previous camera, and their spreads.

    Spreads (J,) are root mean square distances from the middle; 0 where no point agrees.
    """
    motions, positions = solution.motions, solution.points.position_m
    starts = np.cumsum(motions.n_points) - motions.n_points
    agree = motions.inliers[:, None]
    n = np.maximum(motions.n_inliers, 1)[:, None]
    middles = np.add.reduceat(positions * agree, starts) / n
    off = (positions - np.repeat(middles, motions.n_points, axis=0)) * agree
    return middles, np.sqrt((np.add.reduceat(off * off, starts) / n).sum(1))
