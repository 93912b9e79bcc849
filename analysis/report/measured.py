"""What the analyses find in one recording, each computed once and shared by all sections of a report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

from analysis.dampers.nonlinearity import DamperMotion, damper_motion
from analysis.dampers.performance import CycleEnergy, energy_per_cycle
from analysis.decays.free_decay import Decay, decay
from analysis.modal.identification import identify
from analysis.modal.modes import Modes
from analysis.recordings.names import opened, relabelled, scene_labels
from analysis.responses.frequency_responses import frequency_responses, kind_of
from analysis.responses.frf import Frf
from analysis.responses.measurands import located
from analysis.responses.stepped_sine import Sweep, sweeps
from daq.recording.recording import Recording
from rig.errors import ShotrigError

Found = TypeVar("Found")


@dataclass(frozen=True)
class DamperResult:
    """What the dampers did in one sweep.

    motions : one list for each body with a channel, one entry for each frequency
    """

    sweep: Sweep
    motions: tuple[list[DamperMotion], ...]
    energy: CycleEnergy | None


@dataclass(frozen=True)
class Measured:
    """One open recording and what was found in it.

    frfs : one list of responses for each pass through the frequencies
    modes : of each such list, as far as modes were identified
    """

    path: Path
    label: str
    rec: Recording
    frfs: tuple[list[Frf], ...] = ()
    modes: tuple[Modes, ...] = ()
    dampers: tuple[DamperResult, ...] = ()
    decay: Decay | None = None


@dataclass
class Measurements:
    """The recordings of a report, open as long as the `with` lasts, and the warnings about them."""

    paths: Sequence[Path]
    progress: Callable[[int, int], None] | None = None
    all: list[Measured] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    _open: ExitStack = field(default_factory=ExitStack)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for path, label in zip(self.paths, scene_labels(self.paths), strict=True):
                self.all.append(self._measure(path, label, stack.enter_context(opened(path))))
            self._open = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def _measure(self, path: Path, label: str, rec: Recording) -> Measured:
        free = rec.scene.test is not None and rec.scene.test.kind == "free"
        groups: list[list[Frf]] = []
        modes: list[Modes] = []
        if not free:
            found = self._attempt(
                path, "Frequency responses", lambda: frequency_responses(rec, progress=self.progress)
            )
            groups = [[relabelled(frf, rec.scene.name, label) for frf in group] for group in found or ()]
        for group in groups:
            self._note(path, group[0].warnings)
            identified = self._attempt(path, "Modes", lambda curves=group: identify(curves))  # type: ignore[misc]
            if identified is not None:
                modes.append(relabelled(identified, rec.scene.name, label))
                self._note(path, identified.warnings)
        stepped = not free and kind_of(rec) == "tones" and rec.scene.dampers
        dampers = self._attempt(path, "Dampers", lambda: self._dampers(path, rec)) if stepped else None
        decayed = None
        if free or any(marker.kind == "hit" for marker in rec.markers):
            decayed = self._attempt(path, "Free decay", lambda: decay(rec))
            if decayed is not None:
                decayed = relabelled(decayed, rec.scene.name, label)
                self._note(path, decayed.warnings)
        return Measured(path, label, rec, tuple(groups), tuple(modes), tuple(dampers or ()), decayed)

    def _dampers(self, path: Path, rec: Recording) -> list[DamperResult]:
        bodies = sorted({damper.body for damper in rec.scene.dampers if not damper.locked})
        channels = [info.name for body in bodies if (info := located(rec, f"body {body}")) is not None]
        results = []
        for sweep in sweeps(rec, progress=self.progress):
            motions = [
                self._attempt(path, f"Dampers, {name}", lambda at=name, of=sweep: damper_motion(rec, of, at))  # type: ignore[misc]
                for name in channels
            ]
            energy = self._attempt(path, "Energy balance", lambda of=sweep: energy_per_cycle(rec, of))  # type: ignore[misc]
            results.append(DamperResult(sweep, tuple(each for each in motions if each is not None), energy))
        return results

    def _attempt(self, path: Path, what: str, compute: Callable[[], Found]) -> Found | None:
        """Return what an analysis finds, or None with a warning that gives the reason."""
        try:
            return compute()
        except ShotrigError as error:
            self._note(path, [f"{what}: not available. {error}"])
            return None

    def _note(self, path: Path, notes: Sequence[str]) -> None:
        self.warnings += [
            f"{path.name}: {note}" for note in notes if f"{path.name}: {note}" not in self.warnings
        ]
