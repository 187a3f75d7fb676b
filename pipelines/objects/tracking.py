"""The objects of a scene, frame by frame: association, motion, filter, state.

Owns the tracks and points that are kept between frames and the order of steps 5 and 7 to 9. What a
step computes is in the modules beside this one. Ground truth never comes near.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.config import ObjectsConfig
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import (
    MIN_DEPTH_M,
    invert_T,
    make_T,
    orthonormalise,
    project_stereo,
    rotation_vector,
    skew,
    transform_points,
)
from pipelines.object_types import Detections, ObjectEstimates, ObjectState
from pipelines.objects.association import (
    Candidates,
    assign,
    box_overlap,
    color_distance,
    count_votes,
    same_kind,
)
from pipelines.objects.following import Followed, follow_points
from pipelines.objects.instances import Instances, carry_mask, describe_instances
from pipelines.objects.kalman import ObjectFilter, direction_std
from pipelines.objects.motion import (
    GATE_6DOF,
    displacement,
    fuse_motions,
    motion_in_world,
    move_points,
    points_std,
    scale_about,
    world_covariance,
)
from pipelines.objects.motion_state import decide_by_scene_flow, decide_by_speed
from pipelines.objects.points import ObjectPoints, Window, choose_pixels
from pipelines.objects.rows import RowTable
from pipelines.objects.search import match_masks
from pipelines.objects.solver import MotionSolver, Solution
from pipelines.objects.track import ObjectTrack
from pipelines.observations import StereoObservations
from pipelines.types import Array

_FLOW_TOLERANCE_PX = 6.0  # alignment may move a point this far from its flow
_CENTER_SIGMA_M = 0.3  # the visible part of an object has another centre from frame to frame
_PART_SHARE = 0.35  # of an object's size by which the middle of what is seen of it may be off
_DETECTED_SIGMA_M = 1.0  # the centre of a mask, at its median depth
_SEED_GRID_PX = 3  # grid on the previous image that is searched for a new object's pixels
_LASTING_SHARE = 0.5  # of a speed's error stays from frame to frame, as its points do
_SURE_SHARE = 0.6  # of the points that must agree with a motion that nobody expected
_FASTEST_MPS, _FASTEST_RADPS = 20.0, 2.0  # standard deviations of motions not yet known
_MIN_SEARCH_PX = 400  # an object of fewer pixels has too few corners to be found by them
_MIN_CARRIED_POINTS = 6  # tracked points without which a mask is not carried on


@dataclass(slots=True)
class ObjectFrame:
    """One frame on its way through the tracker: what association found, for `estimate`.

    labels: (H, W) int32 by lasting id. windows: id -> where its pixels are. scores: id -> of the
    detection, 0 where the mask was carried. new_ids: objects seen for the first time, or again.
    points, followed: the tracked points of objects in sight, with where they are now.
    noise_was_learned: whether their noise was known when they were followed.
    """

    labels: NDArray[np.int32]
    windows: dict[int, Window]
    scores: dict[int, float]
    new_ids: list[int]
    points: ObjectPoints
    followed: Followed
    noise_was_learned: bool

    def masks(self, shape: tuple[int, ...]) -> Detections:
        """The instances as detections whose labels are lasting ids; names do not matter here."""
        ids = np.array(sorted(self.windows), np.int32)
        scores = np.array([self.scores[int(i)] for i in ids])
        return Detections(self.labels, ids, np.full(len(ids), "object", "U16"), scores)


class ObjectTracker:
    """Tracks every movable object; `associate` before the camera's pose, `estimate` after it."""

    def __init__(self, sensor: Sensor, config: ObjectsConfig, seed: int = 0) -> None:
        self.sensor, self.config, self.camera = sensor, config, sensor.camera
        self._solver = MotionSolver(sensor, config, seed)
        self._tracks: dict[int, ObjectTrack] = {}
        self._points = ObjectPoints.empty()
        self._last: View | None = None
        self._last_labels: NDArray[np.int32] | None = None
        self._last_windows: dict[int, Window] = {}
        self._T_world_last: Array | None = None
        self._next_id = 1

    # ----------------------------------------------------------- association

    def associate(
        self,
        view: View,
        flow_px: NDArray[np.float32] | None,
        detections: Detections,
        T_predicted: Array,
    ) -> ObjectFrame:
        """Which detection is which object, by what is known before the camera's pose; step 7.

        flow_px: (H, W, 2) from the view before, on its grid, or None. T_predicted: (4, 4) expected
        pose of the camera. Objects that are missed keep their masks, carried by flow, for a while;
        detections that are no known object begin one.
        """
        dt_s = 0.0 if self._last is None else view.timestamp_s - self._last.timestamp_s
        for track in self._tracks.values():
            if track.filter is not None:
                track.filter.predict(dt_s)
        instances = describe_instances(self.camera, view.image, view.disparity_px, detections)
        followed = self._follow(view, flow_px, self._points, T_predicted, dt_s)
        ids = list(self._tracks)
        found = assign(self._candidates(ids, instances, followed, T_predicted))
        return self._settle(view, instances, ids, found, followed)

    def _follow(
        self,
        view: View,
        flow_px: NDArray[np.float32] | None,
        points: ObjectPoints,
        T_predicted: Array,
        dt_s: float,
    ) -> Followed:
        """Where points of the last view are now: by flow and by patch alignment, fused."""
        if len(points) == 0:
            return self._follow_by(view, flow_px, points, np.empty((0, 4, 4)), np.empty(0, bool))
        ids, _ = points.groups()
        known = np.array([self._tracks[int(i)].H_world_curr_prev is not None for i in ids])
        Gs = self._predicted_Gs(ids, T_predicted, dt_s)
        return self._follow_by(view, flow_px, points, Gs, known | (flow_px is None))

    def _follow_by(
        self,
        view: View,
        flow_px: NDArray[np.float32] | None,
        points: ObjectPoints,
        Gs: Array,
        known: NDArray[np.bool_],
    ) -> Followed:
        """The same where motions Gs (J, 4, 4) are expected; `known` (J,) says of which objects."""
        expected = np.full((len(points), 2), np.nan)
        if len(points):
            _, sizes = points.groups()
            moved = move_points(Gs, points.position_m, sizes)
            front = (moved[:, 2] > MIN_DEPTH_M) & np.repeat(known, sizes)
            expected[front] = project_stereo(self.camera, moved[front])[:, :2]
        gray = view.gray if self._last is None else self._last.gray
        return follow_points(gray, view.gray, flow_px, points.uv_px, expected, self.sensor.noise)

    def _still_Gs(self, T_world_camera: Array, n: int) -> Array:
        """(n, 4, 4) the motion of what stands still, as the camera sees it."""
        assert self._T_world_last is not None
        return np.repeat((invert_T(T_world_camera) @ self._T_world_last)[None], n, axis=0)

    def _predicted_Gs(self, ids: NDArray[np.int64], T_world_camera: Array, dt_s: float) -> Array:
        """(J, 4, 4) motions from the last camera to this one, if all goes on as before."""
        assert self._T_world_last is not None
        T_curr_world = invert_T(T_world_camera)
        Hs = [self._tracks[int(i)].predicted_motion(dt_s) for i in ids]
        return np.stack([T_curr_world @ H @ self._T_world_last for H in Hs])

    def _candidates(
        self, ids: list[int], instances: Instances, followed: Followed, T_predicted: Array
    ) -> Candidates:
        J, M = len(ids), len(instances)
        row_of = {object_id: row for row, object_id in enumerate(ids)}
        rows = np.array([row_of[int(i)] for i in self._points.object_id], np.int64)
        valid = followed.valid
        areas = np.array([self._tracks[i].area_px for i in ids], float)
        votes, n_points = count_votes(
            rows[valid], instances.labels, followed.uv_px[valid], areas, M
        )
        boxes = np.array([self._tracks[i].box_px for i in ids]).reshape(J, 4)
        centers = transform_points(T_predicted, instances.centers_m)
        distance2, log_spread = np.full((J, M), np.inf), np.zeros((J, M))
        known = np.flatnonzero(np.isfinite(centers[:, 0]))
        for j, object_id in enumerate(ids):
            track = self._tracks[object_id]
            if track.filter is None:
                continue
            # Any part of the object may be what is seen of it
            size_m = float(np.nan_to_num(track.extent_m).max())
            noise = max(_DETECTED_SIGMA_M, _PART_SHARE * size_m) ** 2 * np.eye(3)
            distance2[j, known], log_spread[j] = track.filter.distances2(centers[known], noise)
        colors = np.array([self._tracks[i].color for i in ids])
        colors = colors.reshape(J, instances.colors.shape[1])
        kinds = same_kind(
            [self._tracks[i].class_name for i in ids], [str(n) for n in instances.class_names]
        )
        return Candidates(
            votes,
            n_points,
            box_overlap(boxes, instances.boxes_px),
            distance2,
            log_spread,
            color_distance(colors, instances.colors),
            kinds,
        )

    def _settle(
        self,
        view: View,
        instances: Instances,
        ids: list[int],
        found: NDArray[np.int64],
        followed: Followed,
    ) -> ObjectFrame:
        """Paint lasting ids: of matched detections, of new ones, and of masks carried by flow."""
        t = view.timestamp_s
        table = np.zeros(len(instances) + 1, np.int32)
        windows: dict[int, Window] = {}
        scores: dict[int, float] = {}
        new_ids: list[int] = []
        has_points = set(self._points.object_id.tolist())
        for object_id, m in zip(ids, found, strict=True):
            if m >= 0 and instances.windows[m] is not None:
                table[m + 1] = object_id
                if object_id not in has_points:
                    new_ids.append(object_id)
        for m in np.flatnonzero(instances.n_pixels > 0):
            if table[m + 1] == 0:
                track = ObjectTrack(self._next_id)
                self._tracks[track.object_id] = track
                self._next_id += 1
                table[m + 1] = track.object_id
                new_ids.append(track.object_id)
            object_id = int(table[m + 1])
            score = float(instances.scores[m])
            self._tracks[object_id].take_detection(
                str(instances.class_names[m]), score, instances.colors[m], t
            )
            window = instances.windows[m]
            assert window is not None
            windows[object_id], scores[object_id] = window, score
        labels = table[instances.labels]
        points = self._points
        keep = followed.valid.copy()
        for object_id, m in zip(ids, found, strict=True):
            if m >= 0:
                continue
            own = points.object_id == object_id
            own_found = own & followed.valid
            window = None
            if own_found.sum() >= _MIN_CARRIED_POINTS:
                uv_prev, uv = points.uv_px[own_found], followed.uv_px[own_found]
                window = self._carry(object_id, t, uv_prev, uv, labels)
            if window is None:
                keep &= ~own
            else:
                windows[object_id], scores[object_id] = window, 0.0
        at = np.rint(np.where(keep[:, None], followed.uv_px, 0.0)).astype(np.int64)
        label = labels[at[:, 1], at[:, 0]]
        keep &= (label == points.object_id) | (label == 0)  # not behind another object
        return ObjectFrame(
            labels,
            windows,
            scores,
            new_ids,
            points[keep],
            followed[keep],
            self.sensor.noise.is_learned,
        )

    def _carry(
        self,
        object_id: int,
        t: float,
        uv_prev_px: Array,
        uv_px: Array,
        labels: NDArray[np.int32],
    ) -> Window | None:
        """Paint the last mask of an object where its points went and no detection is; its window."""
        window = self._last_windows.get(object_id)
        track = self._tracks[object_id]
        carried_too_long = t - track.detected_s > self.config.max_carried_s
        if window is None or self._last_labels is None or carried_too_long:
            return None
        carried = carry_mask(
            self._last_labels[window] == object_id, window, uv_prev_px, uv_px, labels.shape
        )
        if carried is None:
            return None
        mask, window = carried
        free = mask & (labels[window] == 0)
        if np.count_nonzero(free) < 0.3 * np.count_nonzero(mask):
            return None
        labels[window][free] = object_id
        return window

    # ---------------------------------------------------------------- motion

    def estimate(
        self,
        view: View,
        flow_px: NDArray[np.float32] | None,
        frame: ObjectFrame,
        T_world_camera: Array,
        pose_covariance: Array,
    ) -> ObjectEstimates:
        """Motion, pose, speed and state of every object, now that the camera's pose is known.

        T_world_camera: (4, 4) with covariance (6, 6) as in `FrameResult`; NaN where it was only
        predicted: then no motion in the world can be told. `frame` is what `associate` answered.
        """
        dt_s = 0.0 if self._last is None else view.timestamp_s - self._last.timestamp_s
        if not frame.noise_was_learned and self.sensor.noise.is_learned:
            # The weights were guesses when the points were followed: once more with better ones
            noise = self.sensor.noise
            noise.borrow("object_flow", "flow")
            noise.borrow("object_alignment", "alignment")
            frame.followed = self._follow(view, flow_px, frame.points, T_world_camera, dt_s)
            frame.points = frame.points[frame.followed.valid]
            frame.followed = frame.followed[frame.followed.valid]
        points, followed = self._with_seeds(view, flow_px, frame, T_world_camera, dt_s)
        table = RowTable(view.frame_index, view.timestamp_s)
        for object_id, (rows, columns) in frame.windows.items():
            box = (columns.start, rows.start, columns.stop - 1, rows.stop - 1)
            self._tracks[object_id].box_px = np.array(box, float)
        solutions: list[Solution] = []
        if len(points) and dt_s > 0.0:
            ids, _ = points.groups()
            still = self._still_Gs(T_world_camera, len(ids))
            hypotheses = (self._predicted_Gs(ids, T_world_camera, dt_s), still)
            solutions.append(self._solver.solve(view.disparity_px, points, followed, hypotheses))
        if dt_s > 0.0:
            solutions += self._search_again(view, flow_px, frame, T_world_camera, solutions)
        measured_ids: set[int] = set()
        if np.isfinite(pose_covariance).all():
            for solution in solutions:
                for j in np.flatnonzero(solution.accepted):
                    if self._take_motion(
                        table, view, frame, solution, int(j), T_world_camera, pose_covariance, dt_s
                    ):
                        measured_ids.add(int(solution.motions.object_id[j]))
        moved = ObjectPoints.concatenate(
            ObjectPoints.empty(), *(self._solver.refine(solution) for solution in solutions)
        )
        self._take_rest(table, view, frame, measured_ids, moved, T_world_camera, dt_s)
        self._remember(view, frame, moved, T_world_camera)
        return table.estimates()

    def _with_seeds(
        self,
        view: View,
        flow_px: NDArray[np.float32] | None,
        frame: ObjectFrame,
        T_world_camera: Array,
        dt_s: float,
    ) -> tuple[ObjectPoints, Followed]:
        """The tracked points, and points of new objects found back in the view before.

        A new object was there before it was detected: the flow says which pixels of the previous
        image lead into its mask, so that it has a motion in its very first frame.
        """
        if not frame.new_ids or flow_px is None or self._last is None:
            return frame.points, frame.followed
        grid = (slice(None, None, _SEED_GRID_PX), slice(None, None, _SEED_GRID_PX))
        H, W = view.gray.shape
        v, u = np.mgrid[0:H:_SEED_GRID_PX, 0:W:_SEED_GRID_PX]
        to = np.nan_to_num(flow_px[grid], nan=1e6)
        x, y = np.rint(u + to[..., 0]).astype(np.int64), np.rint(v + to[..., 1]).astype(np.int64)
        inside = (x >= 0) & (y >= 0) & (x < W) & (y < H)
        label = np.where(inside, frame.labels[np.clip(y, 0, H - 1), np.clip(x, 0, W - 1)], 0)
        if self._last_labels is not None:
            before = self._last_labels[grid]
            before = cv2.dilate(before.astype(np.uint16), np.ones((5, 5), np.uint8))
            label[(before > 0) & (before != label)] = 0  # what stood before it, or beside
        pixels = [self._seed_pixels(label == object_id) for object_id in frame.new_ids]
        owner = np.repeat(np.array(frame.new_ids, np.int64), [len(p) for p in pixels])
        seeds = self._solver.create_points(self._last.disparity_px, owner, np.concatenate(pixels))
        followed = self._follow(view, flow_px, seeds, T_world_camera, dt_s)
        seeds, followed = seeds[followed.valid], followed[followed.valid]
        owners = np.concatenate([frame.points.object_id, seeds.object_id])
        order = np.argsort(owners, kind="stable")
        return (
            ObjectPoints.concatenate(frame.points, seeds),
            Followed.concatenate(frame.followed, followed)[order],
        )

    def _seed_pixels(self, on_grid: NDArray[np.bool_]) -> Array:
        """Pixels (N, 2) of the last view for points of an object that covers these grid nodes."""
        assert self._last is not None
        rows, columns = np.flatnonzero(on_grid.any(1)), np.flatnonzero(on_grid.any(0))
        if len(rows) == 0:
            return np.empty((0, 2))
        part = on_grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        s = _SEED_GRID_PX
        mask = np.repeat(np.repeat(part, s, axis=0), s, axis=1)
        H, W = self._last.gray.shape
        y0, x0 = int(rows[0]) * s, int(columns[0]) * s
        mask = mask[: H - y0, : W - x0]
        window = (slice(y0, y0 + mask.shape[0]), slice(x0, x0 + mask.shape[1]))
        return choose_pixels(
            self._last.gray, mask, window, self.config.max_points, np.empty((0, 2))
        )

    def _search_again(
        self,
        view: View,
        flow_px: NDArray[np.float32] | None,
        frame: ObjectFrame,
        T_world_camera: Array,
        solutions: list[Solution],
    ) -> list[Solution]:
        """A second try, by descriptors, for detected objects that flow and prediction lost."""
        assert self._last is not None
        solved = {int(i) for s in solutions for i in s.motions.object_id[s.accepted]}
        guesses: dict[int, Array] = {}
        for object_id, window in frame.windows.items():
            window_prev = self._last_windows.get(object_id)
            if object_id in solved or window_prev is None or frame.scores[object_id] == 0.0:
                continue
            mask_prev = self._last_labels[window_prev] == object_id
            mask = frame.labels[window] == object_id
            if min(np.count_nonzero(mask_prev), np.count_nonzero(mask)) < _MIN_SEARCH_PX:
                continue
            uv_prev, uv = match_masks(
                self._last.gray, mask_prev, window_prev, view.gray, mask, window
            )
            G = self._solver.guess_by_matches(self._last.disparity_px, uv_prev, uv)
            if G is not None:
                guesses[object_id] = G
        if not guesses:
            return []
        points = self._points[np.isin(self._points.object_id, list(guesses))]
        Gs = np.array([guesses[int(i)] for i in points.groups()[0]])
        if len(points) == 0:
            return []
        followed = self._follow_by(view, flow_px, points, Gs, np.ones(len(Gs), bool))
        points, followed = points[followed.valid], followed[followed.valid]
        if len(points) == 0:
            return []
        Gs = np.array([guesses[int(i)] for i in points.groups()[0]])
        return [self._solver.solve(view.disparity_px, points, followed, (Gs,))]

    # ----------------------------------------------------------------- state

    def _take_motion(
        self,
        table: RowTable,
        view: View,
        frame: ObjectFrame,
        solution: Solution,
        j: int,
        T_world_camera: Array,
        pose_covariance: Array,
        dt_s: float,
    ) -> bool:
        """A solved motion into the object's filter, pose and state; False if too uncertain."""
        assert self._T_world_last is not None
        motions, rows = solution.motions, solution.rows_of(j)
        good = motions.inliers[rows]
        points, observations = solution.points[rows][good], solution.observations[rows][good]
        track = self._tracks[int(motions.object_id[j])]
        H = motion_in_world(motions.Gs_curr_prev[j], T_world_camera, self._T_world_last)
        center_prev = track.box_center_m
        if center_prev is None:
            center_prev = transform_points(self._T_world_last, points.position_m).mean(0)
        covariance = world_covariance(
            motions.covariances[j] + pose_covariance,
            T_world_camera,
            center_prev + displacement(H, center_prev),
        )
        expected, expected_covariance = self._expected_motion(track, center_prev, dt_s)
        fused = fuse_motions(expected, expected_covariance, H, covariance, center_prev)
        if fused.distance2 > GATE_6DOF:
            sure = good.mean() >= _SURE_SHARE and good.sum() >= 2 * self.config.min_points
            if track.H_world_curr_prev is None or not sure:
                return False  # nothing moves like this, or hardly any point says so
        H, covariance = fused.H_world_curr_prev, fused.covariance
        way_m = displacement(H, center_prev)
        center = center_prev + way_m
        spread_m = float(np.sqrt(points.position_m.var(0).sum()))
        turn_std = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
        if turn_std > np.radians(self.config.max_turn_std_deg):
            return False
        if points_std(covariance, spread_m) > self.config.max_speed_std_mps * dt_s:
            return False
        std_mps = direction_std(way_m, covariance[3:, 3:]) / dt_s
        self._update_filter(track, H, covariance, center, dt_s)
        if self.config.motion_rule == "scene_flow":
            flow_m = self._scene_flow(points, observations, T_world_camera)
            state = decide_by_scene_flow(self.config, flow_m)
        else:
            turn_radps = float(np.linalg.norm(track.filter.turn_radps))
            sure_turn_radps = max(0.0, turn_radps - self.config.significance * turn_std / dt_s)
            speed = float(np.linalg.norm(track.filter.velocity_mps)) + sure_turn_radps * spread_m
            std = float(np.hypot(track.filter.speed_std_mps, _LASTING_SHARE * std_mps))
            state = decide_by_speed(self.config, track.state, speed, std)
        track.set_state(state, view.timestamp_s)
        depth_m = float(np.median(points.position_m[:, 2]))
        if 0.0 < self.config.max_depth_m < depth_m:
            table.add(
                track, frame.scores[track.object_id], center_m=center, state=ObjectState.UNKNOWN
            )
            return True
        table.add(
            track,
            frame.scores[track.object_id],
            n_points=int(motions.n_inliers[j]),
            H_world_curr_prev=H,
            motion_covariance=covariance,
            center_m=center,
            speed_mps=float(np.linalg.norm(way_m)) / dt_s,
            speed_std_mps=std_mps,
        )
        return True

    def _update_filter(
        self, track: ObjectTrack, H: Array, covariance: Array, center_m: Array, dt_s: float
    ) -> None:
        """Take a motion into the object's filter and pose. covariance: about the centre (3,) now.

        The filter follows the origin of the object's pose, which moves as its matter does; the
        centre of what is seen of it does not.
        """
        if track.T_world_object is None:
            track.T_world_object = invert_T(H) @ make_T(np.eye(3), center_m)
        origin_prev = track.T_world_object[:3, 3]
        track.T_world_object = orthonormalise(H @ track.T_world_object)
        origin = track.T_world_object[:3, 3]
        A = np.eye(6)
        A[3:, :3] = -skew(origin - center_m)
        covariance_m2 = (A @ covariance @ A.T)[3:, 3:]
        center_covariance = covariance_m2 + _CENTER_SIGMA_M**2 * np.eye(3)
        if track.filter is None:
            track.filter = ObjectFilter(origin, center_covariance, self.config.acceleration_mps2)
        track.filter.update_motion(
            origin,
            center_covariance,
            (origin - origin_prev) / dt_s,
            covariance_m2 / dt_s**2,
            rotation_vector(H) / dt_s,
        )
        track.H_world_curr_prev, track.H_dt_s = H, dt_s
        track.H_covariance = covariance

    def _expected_motion(
        self, track: ObjectTrack, center_m: Array, dt_s: float
    ) -> tuple[Array, Array]:
        """What motion (4, 4) to expect in a time, with covariance (6, 6), before it is measured.

        The last one, changed by what objects can do in the time; of a new object, none, give or
        take the fastest that there is.
        """
        if track.H_world_curr_prev is None:
            std = np.repeat([_FASTEST_RADPS, _FASTEST_MPS], 3) * dt_s
            return np.eye(4), np.diag(std**2)
        share = dt_s / track.H_dt_s
        std = np.repeat([self.config.turn_radps2, self.config.acceleration_mps2], 3)
        std *= dt_s * 0.5 * (dt_s + track.H_dt_s)
        expected = scale_about(track.H_world_curr_prev, center_m, share)
        return expected, track.H_covariance * share**2 + np.diag(std**2)

    def _scene_flow(
        self, points: ObjectPoints, observations: StereoObservations, T_world_camera: Array
    ) -> Array:
        """f = X_k p_k - X_k-1 p_k-1 (N, 3) in m, of the points whose depth is measured now."""
        assert self._T_world_last is not None
        uvr = observations.uvr_px
        z = self.camera.bf / (uvr[:, 0] - uvr[:, 2])
        known = np.isfinite(z)
        from pipelines.geometry import backproject

        now = backproject(self.camera, uvr[known, :2], z[known])
        before = transform_points(self._T_world_last, points.position_m[known])
        return transform_points(T_world_camera, now) - before

    def _take_rest(
        self,
        table: RowTable,
        view: View,
        frame: ObjectFrame,
        measured_ids: set[int],
        moved: ObjectPoints,
        T_world_camera: Array,
        dt_s: float,
    ) -> None:
        """Objects without a motion in this frame: in sight, coasting, or to be forgotten."""
        t = view.timestamp_s
        forgotten = []
        for object_id, track in self._tracks.items():
            window = frame.windows.get(object_id)
            carried = window is not None and frame.scores[object_id] == 0.0
            if carried and object_id not in measured_ids:  # no motion bears it out
                frame.labels[window][frame.labels[window] == object_id] = 0
                del frame.windows[object_id]
                window = None
            if window is not None:
                track.seen_s = t
            if object_id in measured_ids:
                continue
            self._coast(track, dt_s)
            if window is not None:
                self._see_without_motion(table, view, frame, track, T_world_camera)
            elif t - track.seen_s > self.config.max_age_s or track.filter is None:
                forgotten.append(object_id)
            elif track.state in (ObjectState.MOVING, ObjectState.COASTING):
                track.set_state(ObjectState.COASTING, t)
                self._add_coasting(table, track, T_world_camera)
        for object_id in forgotten:
            del self._tracks[object_id]

    def _coast(self, track: ObjectTrack, dt_s: float) -> None:
        if track.T_world_object is not None and track.filter is not None:
            # the filter has been moved on already: its motion takes the pose along
            track.T_world_object = track.predicted_motion(dt_s) @ track.T_world_object
            track.T_world_object[:3, 3] = track.filter.center_m
        track.H_world_curr_prev = None

    def _see_without_motion(
        self,
        table: RowTable,
        view: View,
        frame: ObjectFrame,
        track: ObjectTrack,
        T_world_camera: Array,
    ) -> None:
        window = frame.windows[track.object_id]
        rows, columns = window
        v, u = np.nonzero(frame.labels[window] == track.object_id)
        disparity = view.disparity_px[v + rows.start, u + columns.start]
        disparity = disparity[disparity >= self.sensor.min_disparity_px]
        center = np.full(3, np.nan)
        if len(disparity) and len(v):
            z = self.camera.bf / float(np.median(disparity))
            uv = (float(np.median(u)) + columns.start, float(np.median(v)) + rows.start)
            camera = self.camera
            seen = np.array(
                [(uv[0] - camera.cx) / camera.fx * z, (uv[1] - camera.cy) / camera.fy * z, z]
            )
            center = T_world_camera[:3, :3] @ seen + T_world_camera[:3, 3]
            covariance = _DETECTED_SIGMA_M**2 * np.eye(3)
            if track.filter is None:
                track.filter = ObjectFilter(center, covariance, self.config.acceleration_mps2)
                track.T_world_object = make_T(np.eye(3), center)
            else:
                track.filter.update_center(center, covariance)
                assert track.T_world_object is not None
                track.T_world_object[:3, 3] = track.filter.center_m
        if track.state is not ObjectState.STOPPED:
            track.set_state(ObjectState.UNKNOWN, view.timestamp_s)
        table.add(track, frame.scores[track.object_id], center_m=center)

    def _add_coasting(self, table: RowTable, track: ObjectTrack, T_world_camera: Array) -> None:
        assert track.filter is not None
        table.add(track, np.nan, center_m=track.filter.center_m, box_px=np.full(4, np.nan))

    def _remember(
        self, view: View, frame: ObjectFrame, moved: ObjectPoints, T_world_camera: Array
    ) -> None:
        """Keep what the next frame starts from: agreeing points, and new ones in each mask."""
        moved = moved[np.isin(moved.object_id, np.array(list(frame.windows), np.int64))]
        pixels, owner = [np.empty((0, 2))], [np.empty(0, np.int64)]
        for object_id, window in frame.windows.items():
            own = moved.object_id == object_id
            track = self._tracks[object_id]
            if own.any() and track.T_world_object is not None:
                track.take_points(transform_points(T_world_camera, moved.position_m[own]))
            mask = frame.labels[window] == object_id
            track.area_px = int(np.count_nonzero(mask))
            chosen = choose_pixels(
                view.gray, mask, window, self.config.max_points, moved.uv_px[own]
            )
            pixels.append(chosen)
            owner.append(np.full(len(chosen), object_id, np.int64))
        new = self._solver.create_points(
            view.disparity_px, np.concatenate(owner), np.concatenate(pixels)
        )
        self._points = ObjectPoints.concatenate(moved, new)
        self._last, self._T_world_last = view, T_world_camera
        self._last_labels, self._last_windows = frame.labels, dict(frame.windows)
