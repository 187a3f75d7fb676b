"""Vocabularies on disk: the project's own file, and reading those of DBoW2 and DBoW3.

Owns the formats and their checks. The own one is a numpy archive without pickle: `version`,
`centroids` (M, 32) uint8, `n_children` (M,) int32 and `idf` (W,) float32, as in `Vocabulary`.
"""

from __future__ import annotations

import gzip
import re
import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.vocabulary import Descriptors, Indices, Vocabulary
from pipelines.errors import FormatError
from pipelines.io.files import replacing
from pipelines.types import Array

SHIPPED = Path(__file__).with_name("orb_vocabulary.npz")
VERSION = 1
_TXT_COLUMNS = 35  # parent, leaf or not, 32 bytes, weight
_NODE = re.compile(
    r"nodeId:\s*(\d+)\s*,\s*parentId:\s*(\d+)\s*,\s*weight:\s*([^,\s]+)\s*,\s*"
    r'descriptor:\s*"([^"]*)"'
)
_WORD = re.compile(r"wordId:\s*\d+\s*,\s*nodeId:\s*\d+")
_ADVICE = "copy it again, or leave places.vocabulary empty for the one that comes with the program"


def load_vocabulary(path: Path | str = "") -> Vocabulary:
    """The vocabulary of a file; the shipped one where `path` is empty.

    The suffix tells the format: .npz is the project's own; .txt is DBoW2's text, such as
    ORBvoc.txt; .yml, .yaml and .yml.gz are those of DBoW2 and DBoW3 by OpenCV, of ORB descriptors.
    Raises FormatError where the file is missing, damaged, newer or of another kind.
    """
    file = Path(path).expanduser() if str(path) else SHIPPED
    name = file.name.lower()
    if name.endswith(".npz"):
        return _load_npz(file)
    if name.endswith(".txt"):
        return _load_text(file)
    if name.endswith((".yml", ".yaml", ".yml.gz", ".yaml.gz")):
        return _load_yaml(file)
    raise FormatError(
        f"{file}: expected a vocabulary as .npz, .txt (DBoW2), .yml or .yml.gz (DBoW3), found "
        f"'{file.suffix}'; {_ADVICE}"
    )


def save_vocabulary(vocabulary: Vocabulary, path: Path | str) -> None:
    """Write the project's own format; the same vocabulary gives the same bytes.

    Raises FormatError as `check_name` does, DyObError where the disk refuses.
    """
    path = Path(path)
    check_name(path)
    with replacing(path) as fresh, fresh.open("wb") as file:
        np.savez_compressed(
            file,
            version=np.int64(VERSION),
            centroids=vocabulary.centroids,
            n_children=vocabulary.n_children,
            idf=vocabulary.idf,
        )


def check_name(path: Path) -> None:
    """Raise FormatError unless a vocabulary to be written has a name that will be understood."""
    if path.suffix.lower() != ".npz":
        raise FormatError(
            f"{path}: expected the name of a vocabulary to end in .npz, found '{path.name}'; "
            "choose another name"
        )


def _load_npz(path: Path) -> Vocabulary:
    try:
        with np.load(path, allow_pickle=False) as content:
            version = int(content["version"])
            if version > VERSION:
                raise FormatError(
                    f"{path}: expected a vocabulary of version {VERSION} or before, found version "
                    f"{version} of a newer program; update this one"
                )
            arrays = [content[name] for name in ("centroids", "n_children", "idf")]
        kinds = [array.dtype for array in arrays]
        if kinds != [np.uint8, np.int32, np.float32]:
            raise ValueError(f"arrays of {', '.join(map(str, kinds))}")
        return Vocabulary(*arrays)
    except (OSError, EOFError, KeyError, TypeError, ValueError, MemoryError) as error:
        raise _damaged(path, error) from error
    except (zipfile.BadZipFile, zlib.error, NotImplementedError) as error:
        raise _damaged(path, error) from error


def _load_text(path: Path) -> Vocabulary:
    """DBoW2's text: a line `k L scoring weighting`, then one line a node, from node 1 on."""
    text = _read_text(path)
    head, _, rest = text.partition("\n")
    if len(head.split()) != 4:
        raise _damaged(path, f"a first line other than four numbers: {head[:40]!r}")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # the way it tells of other text
            numbers = np.fromstring(rest, np.float64, sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise _damaged(path, "something other than numbers") from error
    if len(numbers) == 0 or len(numbers) % _TXT_COLUMNS:
        raise _damaged(path, f"{len(numbers)} numbers, not {_TXT_COLUMNS} for each node")
    table = numbers.reshape(-1, _TXT_COLUMNS)
    is_leaf = table[:, 1] != 0
    return _grow(path, table[:, 0], table[:, 2:34], table[:, 34], is_leaf)


def _load_yaml(path: Path) -> Vocabulary:
    """The yml of DBoW2 and DBoW3, as OpenCV writes it.

    Read by patterns: OpenCV's own reader counts from the first node on to get at each one.
    """
    text = _read_text(path)
    nodes = _NODE.findall(text)
    if not nodes:
        raise _damaged(path, "no nodes in it")
    try:
        node, parent = np.array([row[:2] for row in nodes], np.int64).T
        weight = np.array([row[2] for row in nodes], np.float64)
        numbers = " ".join(row[3].replace("dbw3", "") for row in nodes).split()
        table = np.array(numbers, np.float64)
    except (ValueError, OverflowError) as error:
        raise _damaged(path, error) from error
    columns = len(table) // len(nodes)
    if len(table) % len(nodes) or columns not in (32, 34):
        raise _damaged(path, f"{len(table)} numbers as descriptors of {len(nodes)} nodes")
    table = table.reshape(-1, columns)
    if columns == 34 and (table[:, :2] != (0, 32)).any():  # DBoW3 says type and length first
        raise _damaged(path, "descriptors other than 32 bytes of ORB")
    by_id = np.argsort(node)
    at = np.minimum(np.searchsorted(node[by_id], parent), len(node) - 1)
    known = (parent == 0) | (node[by_id[at]] == parent)
    if not known.all() or (np.diff(node[by_id]) == 0).any() or node.min() < 1:
        raise _damaged(path, "nodes without a parent, or twice the same")
    parent = np.where(parent == 0, 0, by_id[at] + 1)
    is_leaf = ~np.isin(np.arange(1, len(node) + 1), parent)
    if len(_WORD.findall(text)) != is_leaf.sum():
        raise _damaged(path, f"not the {is_leaf.sum()} words of its leaves")
    return _grow(path, parent, table[:, -32:], weight, is_leaf)


def _grow(
    path: Path, parent: Array | Indices, descriptors: Array, weight: Array, is_leaf: NDArray
) -> Vocabulary:
    """A vocabulary from rows (N,) of nodes 1 to N, numbered anew level by level.

    parent: node of each, 0 the root. descriptors: (N, 32). weight: (N,), of leaves. is_leaf: (N,).
    """
    N = len(parent)
    if not ((parent >= 0) & (parent <= N) & (parent == np.floor(parent))).all():
        raise _damaged(path, "a parent that is no node")
    if not ((descriptors >= 0) & (descriptors <= 255)).all():
        raise _damaged(path, "descriptors other than 32 bytes of ORB")
    parent = parent.astype(np.int64)
    by_parent = np.argsort(parent, kind="stable") + 1
    n_children = np.bincount(parent, minlength=N + 1)
    if (is_leaf != (n_children[1:] == 0)).any():
        raise _damaged(path, "inner nodes without children, or leaves with some")
    starts = np.cumsum(n_children) - n_children
    levels, n_nodes = [np.zeros(1, np.int64)], 1
    while len(levels[-1]):
        sizes = n_children[levels[-1]]
        ends = np.cumsum(sizes)
        within = np.arange(ends[-1]) + np.repeat(starts[levels[-1]] - ends + sizes, sizes)
        levels.append(by_parent[within])
        n_nodes += len(within)
    if n_nodes != N + 1:
        raise _damaged(path, f"{N + 1 - n_nodes} nodes that hang on no root")
    order = np.concatenate(levels)
    centroids: Descriptors = np.zeros((N + 1, 32), np.uint8)
    centroids[1:] = descriptors[order[1:] - 1].astype(np.uint8)
    leaves = order[n_children[order] == 0]
    idf = weight[leaves - 1].astype(np.float32)
    try:
        return Vocabulary(centroids, n_children[order].astype(np.int32), idf)
    except ValueError as error:
        raise _damaged(path, error) from error


def _read_text(path: Path) -> str:
    try:
        if path.suffix.lower() == ".gz":
            with gzip.open(path, "rt", encoding="utf-8") as file:
                return file.read()
        return path.read_text(encoding="utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, found: object) -> FormatError:
    reason = " ".join(str(found).split()) or type(found).__name__
    return FormatError(f"{path}: expected a vocabulary of ORB words, found {reason}; {_ADVICE}")
