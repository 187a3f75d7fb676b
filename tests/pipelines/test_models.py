"""Networks' files: where they are looked for, checksums, and downloads from a loopback server."""

from __future__ import annotations

import hashlib
import http.server
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines import models
from pipelines.errors import ModelError

CONTENT = b"weights" * 100_000
SHA256 = hashlib.sha256(CONTENT).hexdigest()
NAME = "mask_rcnn_weights"


@pytest.fixture(autouse=True)
def store(tmp_path: Path, monkeypatch) -> Path:
    folder = tmp_path / "store" / "models"
    monkeypatch.setenv("DYOB_MODELS", str(folder))
    return folder


@pytest.fixture
def expect(monkeypatch):
    """A function that changes the entry of the table."""

    def change(**changes) -> None:
        monkeypatch.setitem(models.MODELS, NAME, replace(models.MODELS[NAME], **changes))

    return change


class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        if self.path == "/missing":
            self.send_error(404)
            return
        self.send_response(200)
        self.send_header("Content-Length", str(len(CONTENT)))
        self.end_headers()
        self.wfile.write(CONTENT[: len(CONTENT) // 2] if self.path == "/cut" else CONTENT)

    def log_message(self, *words) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as served:
        thread = threading.Thread(target=served.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{served.server_port}"
        served.shutdown()
        thread.join()


def left(store: Path) -> set[str]:
    return {file.name for file in store.iterdir()} if store.exists() else set()


# ------------------------------------------------------------------------------------- fetching


@pytest.mark.parametrize("sha256", [SHA256, SHA256[:8], ""], ids=["whole", "prefix", "unknown"])
def test_a_download_is_checked_kept_and_noted(server, expect, store, sha256) -> None:
    expect(url=f"{server}/file", sha256=sha256)
    seen = []
    path = models.fetch_model(NAME, lambda done, total: seen.append((done, total)))
    assert path.read_bytes() == CONTENT
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert left(store) == {path.name, f"{path.name}.sha256"}
    note = (store / f"{path.name}.sha256").read_text()
    assert note == f"{SHA256}  {path.name}\n"  # as sha256sum writes it
    assert models.find_model(NAME) == path


@pytest.mark.parametrize(
    ("address", "sha256", "words"),
    [
        ("file", "0" * 64, f"expected the sha256 {'0' * 64}, found {SHA256}; it was not kept"),
        ("cut", SHA256, r"expected 700000 bytes, found 350000|cannot fetch .*cut"),
        ("missing", SHA256, r"cannot fetch .*/missing \(Not Found\); is there a network\?"),
    ],
)
def test_a_bad_download_leaves_nothing(server, expect, store, address, sha256, words) -> None:
    expect(url=f"{server}/{address}", sha256=sha256)
    with pytest.raises(ModelError, match=words) as said:
        models.fetch_model(NAME)
    assert "\n" not in str(said.value)
    assert left(store) == set()


def test_without_a_network_it_says_what_else_to_do(expect) -> None:
    expect(url="http://127.0.0.1:9/file")
    with pytest.raises(ModelError, match=f"is there a network.* `python3 -m app models add {NAME}"):
        models.fetch_model(NAME)


def test_a_bad_download_leaves_the_older_file(server, expect, store) -> None:
    expect(url=f"{server}/file", sha256=SHA256)
    path = models.fetch_model(NAME)
    path.write_bytes(b"damaged")
    expect(url=f"{server}/cut")
    with pytest.raises(ModelError):
        models.fetch_model(NAME)
    assert path.read_bytes() == b"damaged"


def test_what_is_there_and_good_is_not_fetched_again(server, expect) -> None:
    expect(url=f"{server}/file", sha256=SHA256)
    path = models.fetch_model(NAME)
    expect(url=f"{server}/missing")
    assert models.fetch_model(NAME) == path


def test_a_damaged_file_is_fetched_again(server, expect) -> None:
    expect(url=f"{server}/file", sha256=SHA256)
    path = models.fetch_model(NAME)
    path.write_bytes(CONTENT[:-1])
    assert models.fetch_model(NAME).read_bytes() == CONTENT


def test_an_interrupted_download_leaves_nothing(server, expect, store) -> None:
    expect(url=f"{server}/file", sha256=SHA256)

    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        models.fetch_model(NAME, interrupt)
    assert left(store) == set()


def test_what_has_no_address_says_how_to_come_by_it() -> None:
    with pytest.raises(ModelError, match=r"no address.*yolo export .*models add yolo_seg FILE"):
        models.fetch_model("yolo_seg")


# --------------------------------------------------------------------------- adding and finding


def test_a_file_is_added_as_a_checked_copy(expect, store, tmp_path) -> None:
    expect(sha256=SHA256[:8])
    source = tmp_path / "mine.pth"
    source.write_bytes(CONTENT)
    path = models.add_model(NAME, source)
    assert path.parent == store
    assert path.read_bytes() == source.read_bytes() == CONTENT
    source.write_bytes(b"another")
    with pytest.raises(ModelError, match=r"mine\.pth: expected the sha256 .*it was not kept"):
        models.add_model(NAME, source)
    assert path.read_bytes() == CONTENT


def test_adding_nothing_is_an_error(tmp_path) -> None:
    with pytest.raises(ModelError, match="expected a file to add, found none at"):
        models.add_model(NAME, tmp_path / "no.pth")


def test_later_damage_is_seen_even_of_a_file_without_a_known_checksum(tmp_path) -> None:
    source = tmp_path / "mine.onnx"
    source.write_bytes(CONTENT)
    path = models.add_model("yolo_seg", source)
    assert models.find_model("yolo_seg") == path
    path.write_bytes(CONTENT[:-9])
    with pytest.raises(ModelError, match=f"to have the sha256 {SHA256}, found .*damaged") as said:
        models.find_model("yolo_seg")
    assert "models add yolo_seg FILE" in str(said.value)
    assert "\n" not in str(said.value)


def test_a_file_put_there_by_hand_is_found(store) -> None:
    store.mkdir(parents=True)
    (store / "yolo_seg.onnx").write_bytes(CONTENT)
    assert models.find_model("yolo_seg") == store / "yolo_seg.onnx"


def test_a_known_checksum_counts_for_a_file_put_there_by_hand(store, expect) -> None:
    store.mkdir(parents=True)
    models.model_path(NAME).write_bytes(CONTENT)
    with pytest.raises(ModelError, match="to have the sha256 bf2d0c1e, found"):
        models.find_model(NAME)
    expect(sha256=SHA256[:8])
    assert models.find_model(NAME) == models.model_path(NAME)


def test_a_path_of_ones_own_wins(store, tmp_path) -> None:
    own = tmp_path / "own.onnx"
    own.touch()
    assert models.find_model("yolo_seg", str(own)) == own
    with pytest.raises(ModelError, match=r"found nothing at .*absent"):
        models.find_model("yolo_seg", tmp_path / "absent.onnx")


@pytest.mark.parametrize("name", models.MODELS)
def test_a_missing_file_says_what_to_type(name: str) -> None:
    with pytest.raises(ModelError, match="is missing") as said:
        models.find_model(name)
    words = str(said.value)
    assert f"python3 -m app models add {name} FILE" in words
    model = models.MODELS[name]
    assert ("models fetch" in words) == bool(model.url or model.made_from)
    assert (f"--set {model.setting}=FILE" in words) == bool(model.setting)


def test_an_unknown_name_names_the_nearest() -> None:
    with pytest.raises(ModelError, match=r"'mask_rcn'; did you mean 'mask_rcnn'\?"):
        models.find_model("mask_rcn")


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path, monkeypatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("DYOB_MODELS", str(tmp_path / "file" / "models"))
    source = tmp_path / "mine.onnx"
    source.write_bytes(CONTENT)
    with pytest.raises(ModelError, match=r"cannot write .* set DYOB_MODELS to a folder"):
        models.add_model("yolo_seg", source)


def test_the_folder_is_the_users_cache_unless_told(monkeypatch, tmp_path) -> None:
    monkeypatch.delenv("DYOB_MODELS")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert models.models_folder() == tmp_path / "dyob-slam" / "models"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert models.models_folder() == tmp_path / ".cache" / "dyob-slam" / "models"


@pytest.mark.parametrize("name", models.MODELS)
def test_the_table_is_sound(name: str) -> None:
    model = models.MODELS[name]
    assert model.what and model.licence and model.file_name
    assert model.url.startswith("https://") or not model.url
    assert set(model.sha256) <= set("0123456789abcdef")
    assert not model.made_from or model.made_from in models.MODELS
    assert model.url or model.made_from or model.advice, "no way to come by it"
