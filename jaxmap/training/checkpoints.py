"""Checkpoints of a training run, kept by orbax: all that is needed to resume it exactly."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxmap.errors import JaxmapError
from jaxmap.host.files import write_error
from jaxmap.training.step import TrainState

KEPT = 2


class SavedState(NamedTuple):
    """The contents of a checkpoint: the state, and plain values beside it."""

    state: TrainState
    record: dict[str, Any]


class Checkpoints:
    """The checkpoints in a folder; the newest few are kept, each written whole or not at all.

    Args:
        folder: of the checkpoints; made with the first.
    """

    def __init__(self, folder: Path) -> None:
        import orbax.checkpoint as orbax

        # Orbax logs its own progress at length.
        logging.getLogger("absl").setLevel(logging.ERROR)
        self._folder, self._orbax = folder, orbax
        self._manager: Any = None

    def _open(self) -> Any:
        if self._manager is None:
            options = self._orbax.CheckpointManagerOptions(
                max_to_keep=KEPT, create=True, enable_async_checkpointing=False
            )
            self._manager = self._orbax.CheckpointManager(self._folder.resolve(), options=options)
        return self._manager

    def save(self, state: TrainState, record: dict[str, Any]) -> None:
        """Writes a checkpoint of the step that the state has reached.

        Raises:
            JaxmapError: writing failed; earlier checkpoints are whole.
        """
        step, arguments = int(state.step), self._orbax.args
        try:
            if step in self._open().all_steps():
                # A damaged one of the same step, before which the run was resumed.
                self._open().delete(step)
            self._open().save(
                step,
                args=arguments.Composite(state=arguments.StandardSave(_tree(state)), record=arguments.JsonSave(record)),
            )
            self._open().wait_until_finished()
        except OSError as error:
            raise write_error(error, self._folder) from error
        except Exception as error:
            # The storage library has errors of its own for a full or broken disk.
            reason = " ".join(str(error).split())[:160]
            raise JaxmapError(
                f"the checkpoint could not be written ({reason})",
                where=self._folder,
                fix="check the disk, then --resume",
            ) from error

    def restore(self, like: TrainState) -> SavedState | None:
        """The newest checkpoint that can be read, or None where there is none at all.

        Args:
            like: a state of the same network and optimiser.

        Raises:
            JaxmapError: there are checkpoints, but none can be read.
        """
        if not self._folder.is_dir():
            return None
        fault: Exception | None = None
        for step in sorted(self._open().all_steps(), reverse=True):
            try:
                return self._read(step, like)
            except Exception as error:
                # A damaged checkpoint can raise nearly anything; the one before it may serve.
                fault = fault or error
        if fault is None:
            return None
        raise JaxmapError(
            f"no checkpoint can be read ({' '.join(str(fault).split())[:160]})",
            where=self._folder,
            fix="start anew with --overwrite",
        ) from fault

    def _read(self, step: int, like: TrainState) -> SavedState:
        arguments = self._orbax.args
        abstract = jax.tree.map(self._orbax.utils.to_shape_dtype_struct, _tree(like))
        found = self._open().restore(
            step,
            args=arguments.Composite(state=arguments.StandardRestore(abstract), record=arguments.JsonRestore()),
        )
        return SavedState(TrainState(**found["state"]), found["record"])


def _tree(state: TrainState) -> dict[str, Any]:
    return {name: getattr(state, name) for name in ("weights", "average", "optimiser", "step")}
