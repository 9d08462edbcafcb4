"""The project's errors: each names what is wrong, shows the value, and advises what to do.

A person at the command line sees the message alone, on one line, and exit code 2. A batch job writes ``reason`` and
``retryable`` into the item's receipt and goes on with the other items.
"""

from typing import ClassVar


class AnimaticError(Exception):
    """Something a person can mend."""

    reason: ClassVar[str] = "error"
    """A short slug for receipts and tables."""
    retryable: ClassVar[bool] = False
    """Whether the same call may go through later, with nothing changed (no space left, a lost mount)."""


class ConfigError(AnimaticError):
    """A setting, a command-line value or a configuration file that cannot be used."""

    reason = "config"


class VideoError(AnimaticError):
    """A video that cannot be opened, has no picture, or is too short."""

    reason = "video"


class ModelError(AnimaticError):
    """Weights, a model card or a network's output that break their contract."""

    reason = "model"


class TrajectoryError(AnimaticError):
    """Camera poses, intrinsics or trajectory files that cannot be what they claim."""

    reason = "trajectory"


class DataError(AnimaticError):
    """A table, shard, label or receipt that does not hold what its contract says."""

    reason = "data"


class StorageError(AnimaticError):
    """No space left, an unwritable folder, a lost mount."""

    reason = "storage"
    retryable = True
