# SPDX-License-Identifier: Apache-2.0
"""Frames of a live run: those of a recording in real time, and the newest of any iterator."""

from __future__ import annotations

import importlib
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

from manyeyes.datasets.base import Recording
from manyeyes.datasets.frame_reader import as_frame_reader
from manyeyes.datatypes import AgentFrame, ConfigError, RecordingError
from manyeyes.runtime.clock import Clock

_STEP_NS = 20_000_000

FrameSource = Callable[[int, Callable[[], int]], Iterable[AgentFrame]]
"""Called with the agent's id and the clock of the run (TAI, ns): it yields frames with times of that clock."""


def load_source(name: str) -> FrameSource:
    """Return the function of a name "module:function"; modules of the working directory are found, too.

    Raises:
        ConfigError: there is no such module or function.
    """
    module_name, colon, function_name = name.partition(":")
    if not (module_name and colon and function_name):
        raise ConfigError(f"A source of frames is named module:function; got {name!r}.")
    sys.path.insert(0, "")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ConfigError(f"Source {name}: module {module_name} cannot be imported: {error}.") from error
    finally:
        sys.path.remove("")
    function: FrameSource | None = getattr(module, function_name, None)
    if not callable(function):
        raise ConfigError(f"Source {name}: module {module_name} has no function {function_name}.")
    return function


class DeferredClock:
    """The time of a clock that is set later; until then, of another one. Calling it returns ns."""

    def __init__(self, until: Callable[[], int]) -> None:
        self.now_ns = until

    def __call__(self) -> int:
        """Return the time now."""
        return self.now_ns()


def play_recording(
    recording: Recording, scenario: str, agent_id: int, start_ns: int, num_frames: int | None = None
) -> Iterator[AgentFrame]:
    """Yield the frames of one agent with new times: the scenario begins at start_ns. They are read as they are asked for.

    num_frames: number of instants, from the first one on; None for all. Instants that lack the agent are left out.

    Raises:
        RecordingError: the scenario never has the agent.
    """
    reader, length = as_frame_reader(recording), recording.length(scenario)
    if agent_id not in recording.agents(scenario):
        known = ", ".join(map(str, recording.agents(scenario)))
        raise RecordingError(f"Scenario '{scenario}' has no agent {agent_id}; it has {known}.")
    first = reader.present_agents(scenario, 0)
    origin_ns = reader.frame(scenario, 0, first[0]).timestamp_ns
    for index in range(length if num_frames is None else min(num_frames, length)):
        if agent_id in reader.present_agents(scenario, index):
            frame = reader.frame(scenario, index, agent_id)
            yield replace(frame, timestamp_ns=start_ns + frame.timestamp_ns - origin_ns, images=())


class NewestFrame:
    """Iterate over the newest frame of a source, as a thread reads it; older ones that were not asked for in time are skipped.

    A frame is handed over at its time by the clock, not before. Iteration ends with the source, or after :meth:`stop`.
    """

    def __init__(self, frames: Iterable[AgentFrame], clock: Clock) -> None:
        self._frames, self._clock = frames, clock
        self._condition = threading.Condition()
        self._newest: AgentFrame | None = None
        self._error: BaseException | None = None
        self._ended = self._stopped = False
        self.num_skipped = 0
        self._thread = threading.Thread(target=self._read, name="source", daemon=True)

    def __iter__(self) -> Iterator[AgentFrame]:
        self._thread.start()
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._newest is not None or self._ended or self._stopped)
                frame, self._newest = self._newest, None
                if self._error is not None:
                    raise self._error
            if frame is None or self._stopped:
                return
            yield frame

    def stop(self) -> None:
        """End the iteration; a frame that is being worked on is finished."""
        with self._condition:
            self._stopped = True
            self._condition.notify_all()

    def _read(self) -> None:
        try:
            for frame in self._frames:
                while not self._stopped and (left := frame.timestamp_ns - self._clock.now_ns()) > 0:
                    self._clock.sleep(min(left, _STEP_NS))
                if self._stopped:
                    return
                with self._condition:
                    self.num_skipped += self._newest is not None
                    self._newest = frame
                    self._condition.notify_all()
        except Exception as error:
            self._error = error
        finally:
            with self._condition:
                self._ended = True
                self._condition.notify_all()
