"""A network in an ONNX file, run by onnxruntime: on a GPU where there is one, else on the CPU.

Owns the session and the words for a file that is no usable network. Knows no network.
"""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ModelError

_PROVIDERS = ("CUDAExecutionProvider", "ROCMExecutionProvider", "CPUExecutionProvider")
_LOG_ERRORS_ONLY = 3


class OnnxNetwork:
    """One image in, named arrays out. The file is opened at the first use, in whatever thread.

    threads: of the network on the CPU.
    """

    def __init__(self, path: Path, threads: int = 2) -> None:
        self.path = path
        self._threads = threads
        self._opened: Any = None
        self._lock = threading.Lock()

    @property
    def input_shape(self) -> tuple[int | None, ...]:
        """Sides of the input; None where the network takes any."""
        shape = self._session().get_inputs()[0].shape
        return tuple(n if isinstance(n, int) and n > 0 else None for n in shape)

    @property
    def output_types(self) -> dict[str, str]:
        """Name -> onnxruntime's type, such as "tensor(float)", in the file's order."""
        return {output.name: output.type for output in self._session().get_outputs()}

    @property
    def metadata(self) -> dict[str, str]:
        """What the file says of itself."""
        return dict(self._session().get_modelmeta().custom_metadata_map)

    def run(self, image: NDArray[np.float32]) -> dict[str, NDArray[Any]]:
        """Output name -> array, half-precision ones as float32.

        Raises ModelError where the network cannot digest an image of this shape.
        """
        session = self._session()
        taken = session.get_inputs()[0]
        if "float16" in taken.type:
            image = image.astype(np.float16)
        try:
            arrays = session.run(None, {taken.name: image})
        except Exception as error:  # onnxruntime's errors have no root of their own
            raise ModelError(
                f"{self.path}: the network failed on an input of shape {image.shape} "
                f"({_first_line(error)}); its own input is {taken.shape}"
            ) from error
        single = [a.astype(np.float32) if a.dtype == np.float16 else a for a in arrays]
        return dict(zip(self.output_types, single, strict=True))

    def _session(self) -> Any:
        with self._lock:
            if self._opened is None:
                self._opened = _open(self.path, self._threads)
        return self._opened


def _open(path: Path, threads: int) -> Any:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = _LOG_ERRORS_ONLY
    # Idle threads that spin would take the cores that tracking needs between two images.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    there = onnxruntime.get_available_providers()
    try:
        return onnxruntime.InferenceSession(
            str(path), options, providers=[name for name in _PROVIDERS if name in there]
        )
    except Exception as error:  # onnxruntime's errors have no root of their own
        raise ModelError(
            f"{path}: expected a network as an ONNX file, found something that onnxruntime cannot "
            f"open ({_first_line(error)}); get the file anew (`python3 -m app models` says how)"
        ) from error


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
