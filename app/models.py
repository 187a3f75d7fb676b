"""`models`: which networks' files there are, the ways in, and training of a vocabulary.

Owns what a person is told about them. Files, checksums and downloads are in `pipelines/models.py`,
vocabularies in `pipelines/backend/`.
"""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

from app import bootstrap, console
from pipelines.errors import ModelError


def models(arguments: Namespace) -> int:
    """`models [ACTION]`: 0 when it is done; a DyObError says what stood in the way."""
    actions = {
        None: _list,
        "list": _list,
        "fetch": _fetch,
        "add": _add,
        "export": _export,
        "train-vocabulary": _train_vocabulary,
    }
    actions[arguments.action](arguments)
    return 0


def _list(arguments: Namespace) -> None:
    from pipelines.models import MODELS, check_model, how_to_get, is_at_hand, models_folder

    console.say(f"Models' folder: {models_folder()}")
    for name, model in MODELS.items():
        path = models_folder() / model.file_name
        console.say(f"{name}: {model.what}")
        rows = [("    licence:", model.licence)]
        if is_at_hand(name):
            rows.append(("    file:", f"{path}, {_megabytes(path)}"))
            try:
                check_model(name, path)
            except ModelError as error:
                rows.append(("    DAMAGED:", str(error)))
        else:
            size = f", {model.size_mb} MB to download" if model.size_mb else ""
            rows.append(("    file:", f"not there{size}"))
            rows.append(("    to get it:", how_to_get(name)))
        console.rows(rows)


def _fetch(arguments: Namespace) -> None:
    from pipelines.models import check_model, is_at_hand, known_model, model_path

    name = arguments.name
    if known_model(name).made_from:
        if is_at_hand(name):
            check_model(name, model_path(name))
        else:
            _make(name, _download(known_model(name).made_from), model_path(name), unchecked=False)
    else:
        _download(name)
    _say_where(name, model_path(name))


def _download(name: str) -> Path:
    from pipelines.models import fetch_model

    with console.counting(f"fetching {name}, bytes") as progress:
        return fetch_model(name, progress)


def _add(arguments: Namespace) -> None:
    from pipelines.models import add_model

    source = Path(arguments.file).expanduser()
    _check_kind(arguments.name, source)
    _say_where(arguments.name, add_model(arguments.name, source))


def _check_kind(name: str, source: Path) -> None:
    """Raise ModelError where an ONNX file cannot be opened, or is a network of another kind."""
    from pipelines.config import DetectorConfig
    from pipelines.detection import NETWORKS, choose_detector
    from pipelines.models import known_model

    known_model(name)
    if name not in NETWORKS or not source.is_file():
        return
    kind = choose_detector(DetectorConfig(name="auto", model=str(source)), sequence_has_masks=False)
    if kind != name:
        raise ModelError(
            f"{source}: expected a network for {name}, found one with the outputs of {kind}; "
            f"did you mean `{console.PROGRAM} models add {kind} {source}`?"
        )


def _export(arguments: Namespace) -> None:
    from pipelines.models import how_to_get, known_model, model_path

    name = arguments.name
    if not known_model(name).made_from:
        raise ModelError(f"{name} cannot be exported, mask_rcnn can; {how_to_get(name)}")
    if arguments.weights:
        weights = Path(arguments.weights).expanduser()
    elif arguments.unchecked:
        raise ModelError("--unchecked is for weights of your own: name them with --weights FILE")
    else:
        weights = _download(known_model(name).made_from)
    output = Path(arguments.output).expanduser() if arguments.output else model_path(name)
    _make(name, weights, output, arguments.unchecked)
    _say_where(name, output)


def _make(name: str, weights: Path, output: Path, unchecked: bool) -> None:
    """Write the ONNX file of Mask R-CNN, which is the only one that is made here."""
    from pipelines.models import model_path, storing

    if not weights.is_file():
        raise ModelError(f"{name}: expected weights to export, found no file at {weights}")
    bootstrap.ensure_torch()
    from pipelines.detection.mask_rcnn_export import export_mask_rcnn
    from pipelines.io.files import replacing

    into = storing(name) if output == model_path(name) else replacing(output)
    with console.working(f"making {name} from {weights}"), into as fresh:
        export_mask_rcnn(weights, fresh, any_weights=unchecked)


def _train_vocabulary(arguments: Namespace) -> None:
    """Learn the words of images, and write them."""
    from pipelines.backend.training_images import descriptors_of, images_of, own_images
    from pipelines.backend.vocabulary_files import check_name, save_vocabulary
    from pipelines.backend.vocabulary_training import check_tree, train_vocabulary
    from pipelines.config import OrbConfig

    output = Path(arguments.output).expanduser()
    check_name(output)  # minutes before it is needed
    check_tree(arguments.branching, arguments.depth)
    descriptors = []
    for source in arguments.images or [None]:
        with console.working(f"finding ORB features in {source or 'images made here'}"):
            images = own_images() if source is None else images_of(source, arguments.stride)
            descriptors += descriptors_of(images, OrbConfig())
    with console.counting("telling words apart, descriptors") as progress:
        vocabulary = train_vocabulary(
            descriptors, arguments.branching, arguments.depth, arguments.seed, progress
        )
    save_vocabulary(vocabulary, output)
    n_descriptors = sum(map(len, descriptors))
    console.say(
        f"{output}: {vocabulary.n_words} words of {n_descriptors} descriptors in "
        f"{len(descriptors)} images, {output.stat().st_size / 1e6:.1f} MB"
    )
    console.next_steps({"use it": f"run DATA --set places.vocabulary={output}"})


def _say_where(name: str, path: Path) -> None:
    from pipelines.models import known_model, model_path

    console.say(f"{name}: {path}, {_megabytes(path)}; licence: {known_model(name).licence}")
    setting = known_model(name).setting
    if setting:
        section = setting.partition(".")[0]
        own = "" if path == model_path(name) else f" --set {setting}={path}"
        console.next_steps({"use it": f"run DATA --set {section}.name={name}{own}"})


def _megabytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e6:.0f} MB"
