"""The settings of every step: nested frozen dataclasses, the paper's values where it gives any.

Each step gets its own section only. Owns the values' meaning, ranges and sources. Reading them is
in `io.config`, merging and type checks in `settings`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

_ANY = float("inf")


def _check(section: object, **ranges: tuple[float, float]) -> None:
    """Raise ValueError unless each named setting lies within its range, ends included."""
    for name, (low, high) in ranges.items():
        value = getattr(section, name)
        if not low <= value <= high:
            limit = f"at least {low:g}" if high == _ANY else f"{low:g} to {high:g}"
            raise ValueError(f"{name}: expected {limit}, found {value:g}")


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """Step 0: depth from stereo, and which depths count as close."""

    close_baselines: float = 40.0  # a point is close when z < this many baselines (paper)
    max_depth_m: float = 0.0  # m, ThDepth: points beyond are far, 0 = the close rule alone
    relative_error: float = 0.02  # sigma_z / z below which a point is close too
    calibrate_disparity: bool = True  # learn a constant error of the stereo disparities
    sgbm_num_disparities: int = 96  # px, search range of the stereo matcher, multiple of 16
    sgbm_block_size: int = 3  # px, odd
    left_right_max_px: float = 1.0  # px, left-right check of disparities

    def __post_init__(self) -> None:
        _check(self, close_baselines=(1, _ANY), max_depth_m=(0, _ANY), relative_error=(1e-4, 1))
        _check(self, sgbm_num_disparities=(16, 1024), sgbm_block_size=(1, 21))
        _check(self, left_right_max_px=(0, _ANY))


@dataclass(frozen=True, slots=True)
class OrbConfig:
    """Step 3: ORB features on static pixels."""

    n_features: int = 1500  # per image, after even spreading
    n_levels: int = 8  # pyramid levels (ORB-SLAM)
    scale_factor: float = 1.2  # between levels (ORB-SLAM)
    fast_threshold: int = 24  # grey levels, FAST corner threshold after contrast is evened
    mask_dilation_px: int = 7  # px, movable masks grow by this before features are kept off them

    def __post_init__(self) -> None:
        _check(self, n_features=(50, 20000), n_levels=(1, 16), scale_factor=(1.01, 4))
        _check(self, fast_threshold=(1, 100), mask_dilation_px=(0, 100))


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Step 4: camera pose."""

    seed: int = 0  # of RANSAC and every other random choice
    search_radius_px: float = 25.0  # px, around motion-predicted places, without flow
    flow_tolerance_px: float = 6.0  # px, alignment may move a point this far from its flow
    map_radius_px: float = 10.0  # px, around local-map points once the pose is known
    max_hamming: int = 64  # bits of 256, of an accepted ORB match where a place is predicted
    inlier_px: float = 2.0  # px, reprojection error of an inlier of a motion hypothesis
    weak_inlier_share: float = 0.5  # below it dense odometry, then relocalisation joins in
    min_inliers: int = 20  # fewer than this after bundle adjustment is LOST; also to start with
    min_inlier_share: float = 0.1  # so is a smaller share of the points measured
    min_regained_share: float = 0.4  # the same after a LOST frame, far from where motion led
    restart_after_frames: int = 5  # LOST frames with features before tracking starts anew
    use_rgbd_odometry: bool = True  # Open3D's dense odometry as the third hypothesis

    def __post_init__(self) -> None:
        _check(self, seed=(0, 2**31 - 1), search_radius_px=(1, 500), flow_tolerance_px=(0, 100))
        _check(self, map_radius_px=(1, 100), max_hamming=(0, 256), inlier_px=(0.1, 50))
        _check(
            self,
            weak_inlier_share=(0, 1),
            min_inlier_share=(0, 1),
            min_regained_share=(0, 1),
            min_inliers=(6, _ANY),
        )
        _check(self, restart_after_frames=(1, _ANY))


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Step 10: sparse map."""

    keyframe_min_overlap: float = 0.7  # share of tracked points that the last keyframe saw
    keyframe_max_interval: int = 20  # frames between keyframes at most, while the camera moves
    keyframe_min_motion_px: float = 3.0  # px, median in the image since the last keyframe
    min_points_apart_px: float = 5.0  # px, new points keep this far from tracked ones
    local_keyframes: int = 20  # keyframes of the local map by shared points; as many by place
    near_keyframe_baselines: float = 15.0  # keyframes this near in place join the local map
    min_shared_points: int = 15  # points in common that make keyframes covisible (ORB-SLAM)
    min_parallax_deg: float = 1.0  # deg, of a point triangulated from two keyframes
    max_reprojection_px: float = 2.0  # px at octave 0, of a triangulated point
    max_epipolar_px: float = 1.5  # px at octave 0, from the epipolar line
    min_triangulation_baselines: float = 1.0  # baselines between keyframes to triangulate from
    triangulate_with: int = 2  # local keyframes that a new keyframe is triangulated with
    min_found_ratio: float = 0.25  # found / visible below which a point is culled (ORB-SLAM)
    min_observations: int = 3  # frames that must have seen a point of the saved map
    max_relative_depth_sigma: float = 0.1  # standard deviation / distance of a saved point

    def __post_init__(self) -> None:
        _check(self, keyframe_min_overlap=(0, 1), keyframe_max_interval=(1, _ANY))
        _check(self, keyframe_min_motion_px=(0, _ANY), min_points_apart_px=(0, 100))
        _check(self, local_keyframes=(1, _ANY), near_keyframe_baselines=(0, _ANY))
        _check(self, min_shared_points=(1, _ANY), min_parallax_deg=(0.01, 90))
        _check(self, max_reprojection_px=(0.1, 50), max_epipolar_px=(0.1, 50))
        _check(self, min_triangulation_baselines=(0, _ANY), triangulate_with=(0, _ANY))
        _check(self, min_found_ratio=(0, 1), min_observations=(1, _ANY))
        _check(self, max_relative_depth_sigma=(1e-4, _ANY))


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Step 1: instance masks of movable things."""

    # auto: the network of `model` where that is set, else files where the sequence has masks, else
    # yolo_seg or mask_rcnn where its model is at hand, else motion; or one of these four names
    name: str = "auto"
    model: str = ""  # path of the network's ONNX file, empty = where `models fetch` puts it
    every_n: int = 1  # the network runs on every n-th frame; between, masks are carried by flow
    timeout_ms: float = 0.0  # ms, a later answer is not waited for: masks are carried; 0 = wait
    min_score: float = 0.35  # detections below are dropped
    max_instances: int = 100  # the best are kept
    # px, images are scaled to this width for the network; 0 = its own, or for a yolo_seg network of
    # any size that of the image, up to 1280
    input_width_px: int = 0
    threads: int = 2  # of the network on the CPU
    # movable classes, by their COCO names; masks of other classes are not used
    classes: tuple[str, ...] = (
        "person",
        "bicycle",
        "car",
        "motorcycle",
        "bus",
        "train",
        "truck",
        "boat",
        "bird",
        "cat",
        "dog",
        "horse",
        "sheep",
        "cow",
        "sports ball",
        "chair",
        "suitcase",
    )

    def __post_init__(self) -> None:
        _check(self, timeout_ms=(0, _ANY))
        _check(self, every_n=(1, 1000), min_score=(0, 1), max_instances=(1, 1000))
        _check(self, input_width_px=(0, 8192), threads=(1, 256))


@dataclass(frozen=True, slots=True)
class FlowConfig:
    """Step 2: dense optical flow from the previous frame."""

    # auto: files where the sequence has flow, else dis; or one of files, dis, pwc_net
    name: str = "auto"
    preset: str = "medium"  # of dis: ultrafast, fast, medium
    check: bool = False  # also compute the flow back, and drop what does not return
    max_miss_px: float = 1.0  # px, of the check
    model: str = ""  # of pwc_net: path of the weights, empty = where `models fetch` puts them

    def __post_init__(self) -> None:
        _check(self, max_miss_px=(0.01, 100))


@dataclass(frozen=True, slots=True)
class GeometryConfig:
    """Step 6: which pixels move, by depth and flow against the camera's motion, with no network."""

    # auto: unless masks come with the sequence; it then repairs what networks see, and is all
    # there is to the detector `motion`
    use: Literal["auto", "always", "never"] = "auto"
    cell_px: int = 4  # px, side of the cells that all is tested on; finer sees smaller things
    significance: float = 3.5  # standard deviations of noise that a still thing may show
    min_speed_mps: float = 0.15  # m/s, slower things count as still
    max_speed_mps: float = 40.0  # m/s, along the view; faster is a mistake of flow
    max_range_m: float = 60.0  # m, farther cells are not tested
    flow_sigma_px: float = 0.3  # px, least standard deviation of dense flow, of any source
    flow_error_share: float = 0.02  # of the ego-motion flow, which computed flow errs by
    max_flow_miss_px: float = 1.0  # px, flow that leads back no better is not used
    depth_gap_m: float = 0.4  # m, depths that differ by more are different things (DynaSLAM)
    depth_gap_share: float = 0.06  # of the depth, the same for near or far things
    n_references: int = 4  # older views compared with; DynaSLAM takes 5
    reference_every: int = 2  # frames between recent views that are remembered
    max_reference_distance_m: float = 25.0  # m, views from farther away are not compared with
    max_parallax_deg: float = 30.0  # deg, nor cells seen from more than this apart (DynaSLAM)
    min_cells: int = 10  # cells of a region, fewer are not reported
    ground_clearance_m: float = 0.15  # m, things begin at this height above the ground
    min_agreement: float = 0.6  # share of a region's cells that must move alike
    confirm_frames: int = 2  # frames that must find a new thing before it is reported
    min_score: float = 0.2  # nameless instances whose evidence fades below this are dropped

    def __post_init__(self) -> None:
        _check(self, cell_px=(1, 16), significance=(1, 20), min_speed_mps=(0, 100))
        _check(self, max_speed_mps=(0.1, 1000))
        _check(self, max_range_m=(0.5, 1000), flow_sigma_px=(0.001, 10), flow_error_share=(0, 0.5))
        _check(self, max_flow_miss_px=(0.01, 100), depth_gap_m=(0.001, 10))
        _check(self, depth_gap_share=(0.001, 0.5), n_references=(0, 20), reference_every=(1, 100))
        _check(self, max_reference_distance_m=(0.1, 1000), max_parallax_deg=(1, 90))
        _check(self, min_cells=(1, 10000), ground_clearance_m=(0, 1), min_agreement=(0, 1))
        _check(self, confirm_frames=(1, 10), min_score=(0, 1))


@dataclass(frozen=True, slots=True)
class ObjectsConfig:
    """Steps 5, 7, 8 and 9: which objects there are, which of them move, how, and how fast."""

    enabled: bool = True  # false: movable things are masked for the camera and nothing more
    max_points: int = 200  # tracked points of one object
    min_points: int = 12  # fewer that agree with a motion do not prove it
    min_inlier_share: float = 0.4  # nor does a smaller share of the points measured
    # m, ThDepthObj (VDO-SLAM, KITTI): motions of things beyond are not told, 0 = any
    max_depth_m: float = 25.0
    max_speed_std_mps: float = 1.5  # m/s, a less certain speed is not reported
    max_turn_std_deg: float = 0.7  # deg a frame, nor is a motion whose turn is less certain
    # speed: in m/s against its own uncertainty; scene_flow: the paper's threshold in m a frame
    motion_rule: Literal["speed", "scene_flow"] = "speed"
    min_speed_mps: float = 0.3  # m/s, slower is still; the speed of turning counts as well
    significance: float = 3.0  # standard deviations above that to be moving
    scene_flow_m: float = 0.12  # m a frame, a point with more scene flow moves (VDO-SLAM, KITTI)
    scene_flow_share: float = 0.3  # still points above which an object is still (VDO-SLAM, KITTI)
    still_after_s: float = 1.0  # s, a thing still for so long may serve the camera as landmark
    landmarks_below: float = 0.4  # share of features off objects, below which it does
    max_carried_s: float = 0.5  # s, a mask is carried by flow so long without a detection
    max_age_s: float = 3.0  # s, an object out of sight so long is forgotten
    acceleration_mps2: float = 3.0  # m/s^2, how fast objects change their speed (process noise)
    turn_radps2: float = 0.5  # rad/s^2, and how fast their turning

    def __post_init__(self) -> None:
        _check(self, max_points=(6, 5000), min_points=(6, 1000), min_inlier_share=(0, 1))
        _check(self, max_depth_m=(0, _ANY), max_speed_std_mps=(0.001, _ANY))
        _check(self, max_turn_std_deg=(0.001, 180))
        _check(self, min_speed_mps=(0, _ANY), significance=(0, 100))
        _check(self, scene_flow_m=(0, _ANY), scene_flow_share=(0, 1), still_after_s=(0, _ANY))
        _check(self, landmarks_below=(0, 1))
        _check(self, max_carried_s=(0, _ANY), max_age_s=(0, _ANY))
        _check(self, acceleration_mps2=(0.01, _ANY), turn_radps2=(0.01, _ANY))


@dataclass(frozen=True, slots=True)
class PlacesConfig:
    """Step 11: recognition of places seen before."""

    # path of a vocabulary: .npz of `models train-vocabulary`, or DBoW2's or DBoW3's .txt, .yml,
    # .yml.gz; empty = the one that comes with the program
    vocabulary: str = ""
    relocalise_among: int = 5  # keyframes most like a view that are tried when tracking is lost

    def __post_init__(self) -> None:
        _check(self, relocalise_among=(0, 100))


@dataclass(frozen=True, slots=True)
class BackendConfig:
    """Step 11: local bundle adjustment of the latest keyframes, and loops, beside tracking."""

    loop_closing: bool = True  # places seen before correct the drift since then
    # of the latest keyframes, in a large map in which no loop was closed and settled yet
    local_adjustment: bool = True
    local_from_keyframe: int = 60  # in smaller maps points refined at every frame do as well
    full_adjustment: bool = True  # after a loop: all keyframes, with what both its sides mapped
    process: bool = True  # in a process of its own; false: in this one, with the same answers
    # an answer is due a fixed number of frames after its question, and waited for, so that runs
    # repeat to the bit; false: it is taken when it comes, for live use
    wait: bool = True
    local_keyframes: int = 6  # keyframes that move: the latest, and those that share most with it
    held_keyframes: int = 12  # other keyframes that see their points, which stay
    points_per_keyframe: int = 300  # in the full adjustment, 0 = all
    rounds: int = 2  # solutions, each without the outliers of the one before
    iterations: int = 10  # of Levenberg-Marquardt in a round
    latency_frames: int = 2  # frames from question to answer at least
    observations_per_frame: int = 1500  # one frame more for each so many

    def __post_init__(self) -> None:
        _check(self, local_keyframes=(1, 1000), held_keyframes=(1, 1000))
        _check(self, points_per_keyframe=(0, _ANY), local_from_keyframe=(0, _ANY))
        _check(self, rounds=(1, 10), iterations=(1, 100))
        _check(self, latency_frames=(1, 1000), observations_per_frame=(1, _ANY))


@dataclass(frozen=True, slots=True)
class BatchConfig:
    """Step 12: the batches that optimise what has been seen so far, or all of a run."""

    at_end: bool = True  # the global batch runs when a run is over; `optimize` does it again
    record: bool = True  # keep what every frame saw in the result folder, for `optimize`
    with_objects: bool = True  # false: cameras and static points alone
    rounds: int = 2  # solutions, each without the outliers of the one before
    max_steps: int = 5  # of Levenberg-Marquardt in a round
    acceleration_mps2: float = 0.5  # m/s^2, standard deviation of the change of a speed
    turn_radps2: float = 0.1  # rad/s^2, and of the change of a turn
    planar_sigma: float = 0.0  # tilt and lift of road vehicles as a share of their way, 0 = free
    held_out_share: float = 0.1  # of the sightings, which judge whether the batch is believed
    guard: bool = True  # refuse what these show to be worse; false: for comparisons
    max_static_per_frame: int = 0  # static points of a frame, the longest tracks first, 0 = all
    covariances: bool = True  # standard deviations of the final poses
    # partial: cameras and static points alone, in windows. point_motion: VDO-SLAM's formulation
    method: Literal["global", "partial", "point_motion"] = "global"
    partial_window: int = 20  # frames of a window of the partial batch (paper)
    partial_overlap: int = 4  # frames that a window shares with the one before (paper)

    def __post_init__(self) -> None:
        _check(self, rounds=(1, 10), max_steps=(1, 100))
        _check(self, acceleration_mps2=(1e-3, _ANY), turn_radps2=(1e-3, _ANY))
        _check(self, planar_sigma=(0, 1), held_out_share=(0.01, 0.5))
        _check(self, max_static_per_frame=(0, _ANY))
        _check(self, partial_window=(4, 1000), partial_overlap=(1, 1000))


@dataclass(frozen=True, slots=True)
class Config:
    """The whole system's settings."""

    depth: DepthConfig = field(default_factory=DepthConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    flow: FlowConfig = field(default_factory=FlowConfig)
    geometry: GeometryConfig = field(default_factory=GeometryConfig)
    orb: OrbConfig = field(default_factory=OrbConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    objects: ObjectsConfig = field(default_factory=ObjectsConfig)
    places: PlacesConfig = field(default_factory=PlacesConfig)
    backend: BackendConfig = field(default_factory=BackendConfig)
    batch: BatchConfig = field(default_factory=BatchConfig)
