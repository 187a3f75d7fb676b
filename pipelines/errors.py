"""The errors a user may meet, all under one root that `app` turns into exit codes.

Every message says what was expected, what was found and what to do. Losing track is not an error:
it is data (`TrackingStatus.LOST`).
"""


class DyObError(Exception):
    """Root of all errors that are the input's or the machine's fault, not the code's."""


class DatasetError(DyObError):
    """A sequence cannot be opened: wrong tree, no calibration, nothing to read."""


class FrameError(DatasetError):
    """One frame of a sequence cannot be read; the run skips it, says so and goes on."""


class ConfigError(DyObError):
    """A setting is unknown or out of its range."""


class ModelError(DyObError):
    """A network's file is missing, damaged or not the expected one."""


class FormatError(DyObError):
    """A file of a result folder or a map does not hold what its format promises."""
