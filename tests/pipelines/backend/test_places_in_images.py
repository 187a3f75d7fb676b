"""Places seen again, by words of real and rendered images: they rank first, others stay below."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
import pytest

from pipelines.backend.place_database import PlaceCandidates, PlaceDatabase
from pipelines.backend.training_images import images_of, paint_leaves
from pipelines.backend.vocabulary import Vocabulary
from pipelines.backend.vocabulary_files import load_vocabulary
from pipelines.config import OrbConfig
from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.depth import to_gray
from pipelines.errors import DatasetError
from pipelines.frontend.orb import OrbExtractor
from pipelines.frontend.view import normalise_contrast
from pipelines.types import Features, Image

ELSEWHERE = 1000  # added to the frame indices of another place


@pytest.fixture(scope="module")
def vocabulary() -> Vocabulary:
    return load_vocabulary()


@pytest.fixture(scope="module")
def orb() -> OrbExtractor:
    return OrbExtractor(OrbConfig())


def features_of(orb: OrbExtractor, image: Image) -> Features:
    gray = to_gray(image)
    return orb.extract(gray, detect_on=normalise_contrast(gray))


def bag_of(vocabulary: Vocabulary, orb: OrbExtractor, image: Image):
    return vocabulary.describe(vocabulary.words(features_of(orb, image).descriptors))


def remember(
    database: PlaceDatabase,
    vocabulary: Vocabulary,
    orb: OrbExtractor,
    sequence: Sequence,
    frames: Iterable[int],
    offset: int = 0,
) -> None:
    for k in frames:
        database.add(offset + k, bag_of(vocabulary, orb, sequence.read(k).image))


def best_of(found: PlaceCandidates, wanted: np.ndarray) -> float:
    return max(found.scores[wanted[found.keyframes]], default=0.0)


def worn(image: Image) -> Image:
    """Darker, blurred and noisy, as on another day."""
    blurred = cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float64)
    noise = np.random.default_rng(0).normal(0.0, 2.0, image.shape)
    return np.clip(0.7 * blurred + noise, 0, 255).astype(np.uint8)


def test_a_rendered_place_seen_again_ranks_first(street, other_place, vocabulary, orb) -> None:
    """Every fourth frame of a drive is remembered; the others between come again, worn."""
    database = PlaceDatabase(vocabulary.n_words)
    remember(database, vocabulary, orb, street, range(0, 20, 4))
    remember(database, vocabulary, orb, other_place, range(6), ELSEWHERE)
    for k in (1, 5, 9, 13, 17):
        found = database.query(bag_of(vocabulary, orb, worn(street.read(k).image)))
        assert found.keyframes[0] == k - 1
        elsewhere = found.keyframes >= ELSEWHERE
        assert 0.05 < found.scores[0] < 0.6
        assert found.scores[0] > 1.2 * found.scores[elsewhere].max()


def test_the_loop_of_a_real_kitchen_is_found(real_data, vocabulary, orb) -> None:
    """The end of the sequence sees what frames 44 to 64 saw; a street lies between, for more."""
    kitchen = open_sequence(real_data("7scenes_redkitchen_200f"))
    road = open_sequence(real_data("kitti_odom06_000-050_stereo"))
    database = PlaceDatabase(vocabulary.n_words)
    remember(database, vocabulary, orb, kitchen, range(0, 160, 8))
    remember(database, vocabulary, orb, road, range(0, 51, 10), ELSEWHERE)
    Ts = kitchen.ground_truth().Ts_world_camera
    for k in (188, 192, 196, 199):
        found = database.query(bag_of(vocabulary, orb, kitchen.read(k).image))
        near_m = np.linalg.norm(Ts[:, :3, 3] - Ts[k, :3, 3], axis=1)
        turn_deg = np.degrees(np.arccos(np.clip(Ts[:, :3, 2] @ Ts[k, :3, 2], -1, 1)))
        is_loop = (near_m < 0.6) & (turn_deg < 25)
        is_other = turn_deg > 40
        best = found.keyframes[0]
        assert best < ELSEWHERE
        assert is_loop[best]
        assert 0.08 < found.scores[0] < 0.4
        of_kitchen = found.keyframes < ELSEWHERE
        inside = PlaceCandidates(found.keyframes[of_kitchen], found.scores[of_kitchen])
        assert found.scores[0] > 1.2 * best_of(inside, is_other)
        assert found.scores[0] > 1.2 * found.scores[~of_kitchen].max()


def test_images_come_from_files_folders_and_sequences(vdo_folder, tmp_path) -> None:
    (tmp_path / "plain").mkdir()
    for k in (0, 2, 10):
        cv2.imwrite(str(tmp_path / f"plain/{k}.png"), np.full((40, 50), k, np.uint8))
    assert [int(image[0, 0]) for image in images_of(str(tmp_path / "plain"))] == [0, 2, 10]
    assert [int(image[0, 0]) for image in images_of(str(tmp_path / "plain"), 2)] == [0, 10]
    assert [int(image[0, 0]) for image in images_of(str(tmp_path / "plain/2.png"))] == [2]
    sequence = open_sequence(vdo_folder)
    found = list(images_of(str(vdo_folder), 4))
    assert len(found) == 3
    assert all((image == sequence.read(4 * k).image).all() for k, image in enumerate(found))
    for nothing in (tmp_path / "absent", tmp_path / "empty"):
        with pytest.raises(DatasetError, match=f"{nothing.name}: expected"):
            list(images_of(str(nothing)))
        (tmp_path / "empty").mkdir(exist_ok=True)


def test_painted_leaves_differ_by_seed_alone() -> None:
    first, again, other = (paint_leaves(seed) for seed in (5, 5, 6))
    assert (first == again).all()
    assert (first != other).mean() > 0.9
    assert first.shape == (480, 640)
    assert 30 < first.std() < 90
