"""The objects of a scene, frame by frame: association, motion, filter, state.

Owns the tracks, what is kept between frames, and the order of steps 5 and 7 to 9. What a step
computes is in the modules beside this one. Ground truth never comes near.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.config import ObjectsConfig
from pipelines.frame_observations import Sightings
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import invert_T, transform_points
from pipelines.object_types import UNNAMED_CLASS, Detections, ObjectEstimates
from pipelines.objects.expectation import Expectation
from pipelines.objects.following import Followed
from pipelines.objects.frame import LastObjects, ObjectFrame
from pipelines.objects.identification import carry_missed, identify
from pipelines.objects.instances import Instances, describe_instances, relabelled
from pipelines.objects.looking_back import guess_motions, seed_pixels
from pipelines.objects.motion_intake import MotionIntake
from pipelines.objects.points import ObjectPoints, choose_pixels, points_wanted
from pipelines.objects.rows import RowTable
from pipelines.objects.sightings import collect_sightings
from pipelines.objects.solver import MotionSolver, Solution
from pipelines.objects.track import ObjectTrack
from pipelines.objects.unmeasured_intake import UnmeasuredIntake
from pipelines.types import Array

_ENOUGH = 0.8  # of the points wanted on an object, above which no new ones are taken


class ObjectTracker:
    """Tracks every movable object; `associate` before the camera's pose, `estimate` after it."""

    def __init__(self, sensor: Sensor, config: ObjectsConfig, seed: int = 0) -> None:
        self.sensor, self.config, self.camera = sensor, config, sensor.camera
        self.tracks: dict[int, ObjectTrack] = {}
        self._solver = MotionSolver(sensor, config, seed)
        self._last: LastObjects | None = None
        self._next_id = 1
        self.sightings = Sightings.empty()  # of the last frame, for the observation log

    # ----------------------------------------------------------- association

    def associate(
        self, view: View, detections: Detections | None, T_predicted: Array
    ) -> ObjectFrame:
        """Which detection is which object, by what is known before the camera's pose; step 7.

        detections: None where there is no answer for this frame. T_predicted: (4, 4) expected pose
        of the camera. Objects that are missed keep their masks, carried by flow, for a while;
        detections that are no known object begin one. Where objects are not wanted, what was
        detected is what it is, and nothing of it is remembered.
        """
        if not self.config.enabled:
            seen = Detections.empty(view.gray.shape) if detections is None else detections
            nothing = ObjectPoints.empty(), Followed.empty()
            return ObjectFrame(seen.labels, detections is not None, *nothing, False)
        dt_s = self._time_since_last(view)
        for track in self.tracks.values():
            track.predict(dt_s)
        last_points = ObjectPoints.empty() if self._last is None else self._last.points
        followed = Followed.empty()
        if self._last is not None:
            expectation = Expectation(self.sensor, self.tracks, self._last, view, T_predicted)
            followed = expectation.follow(last_points)
        answered = detections is not None
        instances = describe_instances(
            self.camera,
            view.image,
            view.disparity_px,
            detections if detections is not None else Detections.empty(view.gray.shape),
        )
        found = identify(self.tracks, instances, last_points, followed, T_predicted)
        frame = ObjectFrame(
            np.zeros(view.gray.shape, np.int32),
            answered,
            last_points,
            followed,
            self.sensor.noise.is_learned,
        )
        known = list(self.tracks)
        self._paint(frame, instances, found)
        for object_id in known:
            if object_id not in found:
                self._carry(frame, object_id, dt_s)
        self._keep_points_in_sight(frame)
        return frame

    def revise(
        self, view: View, frame: ObjectFrame, detections: Detections, T_world_camera: Array
    ) -> dict[int, int]:
        """Take in what geometry makes of the frame's instances once the camera's pose is known.

        detections: their labels are lasting ids where they go on, others where they are new.
        Returns the lasting id of every label.
        """
        instances = describe_instances(self.camera, view.image, view.disparity_px, detections)
        labels = [int(label) for label in detections.label_ids]
        found = {label: m for m, label in enumerate(labels) if label in frame.windows}
        lost = {i: t for i, t in self.tracks.items() if i not in frame.windows}
        again = identify(lost, instances, frame.points, frame.followed, T_world_camera)
        found |= {i: m for i, m in again.items() if labels[m] not in frame.windows}
        frame.windows, frame.new_ids = {}, [i for i in frame.new_ids if i in found]
        frame.carried_ids &= set(found)
        scores, frame.scores = frame.scores, {}
        painted = self._paint(frame, instances, found, scores)
        self._keep_points_in_sight(frame)
        return {label: painted[m] for m, label in enumerate(labels) if painted[m] > 0}

    def _paint(
        self,
        frame: ObjectFrame,
        instances: Instances,
        found: dict[int, int],
        scores: dict[int, float] | None = None,
    ) -> list[int]:
        """Lasting ids for all instances: of known objects, and of ones that begin here.

        scores: of objects whose score and class are known already, and do not count again. Returns
        the id of every instance, 0 where it has no pixel.
        """
        table = np.zeros(len(instances) + 1, np.int32)
        has_points = set(frame.points.object_id.tolist())
        for known_id, m in found.items():
            table[m + 1] = known_id
        for m, window in enumerate(instances.windows):
            if window is None:
                continue
            if table[m + 1] == 0:
                table[m + 1] = self._next_id
                self.tracks[self._next_id] = ObjectTrack(self._next_id, self.config)
                self._next_id += 1
            object_id = int(table[m + 1])
            if object_id not in has_points and object_id not in frame.new_ids:
                frame.new_ids.append(object_id)
            score = float(instances.scores[m])
            if scores is not None and object_id in scores:
                nameless = str(instances.class_names[m]) == UNNAMED_CLASS
                score = score if nameless else scores[object_id]
                if nameless:  # geometry drops what it does not see
                    frame.carried_ids.discard(object_id)
                    self.tracks[object_id].unconfirmed_s = 0.0
            else:
                self.tracks[object_id].take_detection(
                    str(instances.class_names[m]), score, instances.colors[m]
                )
            frame.windows[object_id], frame.scores[object_id] = window, score
        frame.labels = relabelled(instances.labels, table)
        return [int(i) for i in table[1:]]

    def _carry(self, frame: ObjectFrame, object_id: int, dt_s: float) -> None:
        """Go on with the mask of an object that this frame's detections lack."""
        track = self.tracks[object_id]
        track.unconfirmed_s += dt_s
        if frame.answered:
            track.missed_s += dt_s
        if self._last is None:
            return
        window = carry_missed(self.config, track, self._last, frame.followed, frame.labels)
        if window is not None:
            frame.windows[object_id], frame.scores[object_id] = window, 0.0
            frame.carried_ids.add(object_id)

    def _keep_points_in_sight(self, frame: ObjectFrame) -> None:
        """Drop the points that are lost, behind another object, or of an object out of sight."""
        keep = frame.followed.valid & np.isin(frame.points.object_id, list(frame.windows))
        at = np.rint(np.where(keep[:, None], frame.followed.uv_px, 0.0)).astype(np.int64)
        label = frame.labels[at[:, 1], at[:, 0]]
        keep &= (label == frame.points.object_id) | (label == 0)
        frame.points, frame.followed = frame.points[keep], frame.followed[keep]

    def class_names(self) -> dict[int, str]:
        """Class of every object that is remembered, by id."""
        return {i: track.class_name for i, track in self.tracks.items()}

    def landmark_ids(self, timestamp_s: float) -> list[int]:
        """Objects that have stood still for so long that the camera may rely on them."""
        return [i for i, track in self.tracks.items() if track.is_landmark(timestamp_s)]

    def move_world(self, C: Array) -> None:
        """Let all objects follow a correction of the map: p_new = C (4, 4) @ p_old."""
        for track in self.tracks.values():
            track.move_world(C)
        if self._last is not None:
            self._last = replace(self._last, T_world_camera=C @ self._last.T_world_camera)

    def _time_since_last(self, view: View) -> float:
        return 0.0 if self._last is None else view.timestamp_s - self._last.view.timestamp_s

    # ---------------------------------------------------------------- motion

    def estimate(
        self, view: View, frame: ObjectFrame, T_world_camera: Array, pose_covariance: Array
    ) -> ObjectEstimates:
        """Motion, pose, speed and state of every object, now that the camera's pose is known.

        frame: what `associate` answered, perhaps revised. T_world_camera: (4, 4) with covariance
        (6, 6) as in `FrameResult`; NaN where it was only predicted: no motion is told then, nor in
        the frame after. No rows where objects are not wanted.
        """
        if not self.config.enabled:
            return ObjectEstimates.empty()
        table = RowTable(view.frame_index, view.timestamp_s)
        for object_id in frame.windows:
            self.tracks[object_id].box_px = frame.box_px(object_id)
        solutions = self._solve(view, frame, T_world_camera)
        is_tracked = bool(np.isfinite(pose_covariance).all())
        measured_ids: set[int] = set()
        if is_tracked and self._last is not None and self._last.is_tracked:
            intake = MotionIntake(
                self.camera, self.config, self._last, view, T_world_camera, pose_covariance
            )
            for solution in solutions:
                measured_ids.update(intake.take(solution, self.tracks, frame, table))
        rest = UnmeasuredIntake(self.sensor, self.config, view, frame, T_world_camera)
        rest.take(self.tracks, measured_ids, self._time_since_last(view), table)
        moved = [self._solver.refine(solution) for solution in solutions]
        points = self._renew_points(view, frame, T_world_camera, ObjectPoints.concatenate(*moved))
        self._note_sightings(view, solutions, moved, points)
        self._last = LastObjects(
            view, T_world_camera, is_tracked, frame.labels, dict(frame.windows), points
        )
        return table.estimates()

    def _note_sightings(
        self, view: View, solutions: list[Solution], moved: list[ObjectPoints], points: ObjectPoints
    ) -> None:
        last = self._last
        before = ObjectPoints.empty() if last is None else last.points
        frames = (-1 if last is None else last.view.frame_index, view.frame_index)
        sigma = self.sensor.noise.sigma_disparity_px
        self.sightings = collect_sightings(
            self.camera, frames, solutions, moved, before, points, sigma
        )

    def _solve(self, view: View, frame: ObjectFrame, T_world_camera: Array) -> list[Solution]:
        """Eq. (3) for all objects in sight, and once more for those that flow has lost."""
        last = self._last
        if last is None or self._time_since_last(view) <= 0.0:
            return []
        expectation = Expectation(self.sensor, self.tracks, last, view, T_world_camera)
        if not frame.noise_was_learned and self.sensor.noise.is_learned:
            self._follow_again(frame, expectation)
        points, followed = self._with_seeds(frame, expectation)
        solutions = []
        if len(points):
            ids, _ = points.groups()
            still = invert_T(T_world_camera) @ last.T_world_camera
            hypotheses = (
                expectation.motions(ids),
                np.repeat(still[None], len(ids), axis=0),
            )
            solutions.append(self._solver.solve(view.disparity_px, points, followed, hypotheses))
        solved = {int(i) for s in solutions for i in s.motions.object_id[s.accepted]}
        guesses = guess_motions(self._solver, last, view, frame, solved)
        points = last.points[np.isin(last.points.object_id, list(guesses))]
        if len(points):
            Gs = np.stack([guesses[int(i)] for i in points.groups()[0]])
            followed = expectation.follow_by(points, Gs, np.ones(len(Gs), bool))
            points, followed = points[followed.valid], followed[followed.valid]
        if len(points):
            Gs = np.stack([guesses[int(i)] for i in points.groups()[0]])
            solutions.append(self._solver.solve(view.disparity_px, points, followed, (Gs,)))
        return solutions

    def _follow_again(self, frame: ObjectFrame, expectation: Expectation) -> None:
        """The weights were guesses when the points were followed: once more with better ones."""
        noise = self.sensor.noise
        noise.borrow("object_flow", "flow")
        noise.borrow("object_alignment", "alignment")
        frame.followed = expectation.follow(frame.points)
        self._keep_points_in_sight(frame)

    def _with_seeds(
        self, frame: ObjectFrame, expectation: Expectation
    ) -> tuple[ObjectPoints, Followed]:
        """The tracked points, and points of new objects found back in the view before."""
        last, flow_px = expectation.last, expectation.view.flow_prev_to_curr_px
        if not frame.new_ids or flow_px is None:
            return frame.points, frame.followed
        ids, uv = seed_pixels(last, frame, flow_px, self.config.max_points)
        seeds = self._solver.create_points(last.view.disparity_px, ids, uv)
        followed = expectation.follow(seeds)
        seeds, followed = seeds[followed.valid], followed[followed.valid]
        owners = np.concatenate([frame.points.object_id, seeds.object_id])
        return (
            ObjectPoints.concatenate(frame.points, seeds),
            Followed.concatenate(frame.followed, followed)[np.argsort(owners, kind="stable")],
        )

    def _renew_points(
        self, view: View, frame: ObjectFrame, T_world_camera: Array, moved: ObjectPoints
    ) -> ObjectPoints:
        """What the next frame starts from: points that agreed, and new ones in each mask."""
        moved = moved[np.isin(moved.object_id, list(frame.windows))]
        pixels: list[Array] = [np.empty((0, 2))]
        owner = [np.empty(0, np.int64)]
        for object_id, window in frame.windows.items():
            track, own = self.tracks[object_id], moved.object_id == object_id
            if own.any() and track.T_world_object is not None:
                track.take_points(transform_points(T_world_camera, moved.position_m[own]))
            mask = frame.mask(object_id)
            track.area_px = int(np.count_nonzero(mask))
            wanted = points_wanted(track.area_px, self.config.max_points)
            if own.sum() >= _ENOUGH * wanted:
                continue
            chosen = choose_pixels(view.gray, mask, window, wanted, moved.uv_px[own])
            pixels.append(chosen)
            owner.append(np.full(len(chosen), object_id, np.int64))
        new = self._solver.create_points(
            view.disparity_px, np.concatenate(owner), np.concatenate(pixels)
        )
        return ObjectPoints.concatenate(moved, new)
