# SPDX-License-Identifier: Apache-2.0
"""Strategies by name: ours, and those of third parties (entry points of the group manyeyes.strategy).

Every strategy has two forms. NAME fuses the present sweep and the newest message of each sender; NAME-temporal also what was seen
and received in the last HISTORY_FRAMES frames. Tables compare methods of one form. Common to all: a detector reads two sweeps, and
velocities are estimated over half a second (``agents.velocity``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

from manyeyes.agents.perception_cache import PerceptionCache
from manyeyes.agents.strategies.names import current_name
from manyeyes.datatypes import AgentFrame, Boxes, Message
from manyeyes.datatypes.registry import Registry
from manyeyes.models.score_calibration import ScoreForm


class FusionStrategy(Protocol):
    """Composition and fusion of messages of one collaboration scheme; a class may derive from it, which gives the defaults.

    Attributes:
        uses_history: older messages of each sender are fused too, also of senders without a current message.
        needs_tokens: it needs a TokenDetector.
        uses_points: it fuses the clouds of messages; packets of clouds are refused otherwise, since their decoding takes time.
        waits_for_messages: the ego answers when its latency budget has passed; false: at once, since it fuses no messages.
        needs_request_map: its messages with tokens carry a request map, whatever the settings of the agent.
        score_form: form of its boxes, by which their scores are calibrated (``models.score_calibration``).
    """

    uses_history: bool = False
    needs_tokens: bool = False
    uses_points: bool = True
    waits_for_messages: bool = True
    needs_request_map: bool = False
    score_form: ScoreForm = "own"

    def compose_message(
        self, cache: PerceptionCache, frame: AgentFrame, requests: Sequence[Message] = ()
    ) -> Message | None:
        """Compose the message of a frame, before selection and encoding; None sends nothing.

        The tokens of highest ``Message.token_score`` are kept within a budget. requests: received messages, whose request maps
        may weight that score.
        """
        ...

    def record_sent(self, cache: PerceptionCache, frame: AgentFrame, message: Message) -> None:
        """Record the message of a frame as it was sent, with the selected tokens only."""

    def fuse(self, cache: PerceptionCache, frame: AgentFrame, messages: Sequence[Message]) -> Boxes:
        """Return boxes in the agent's frame, from its own cloud and received messages."""
        ...


_STRATEGIES: Registry[Callable[[], FusionStrategy]] = Registry(
    "strategy", "manyeyes.strategy", "manyeyes.agents.strategies"
)

register_strategy = _STRATEGIES.register
"""Return a decorator that registers a strategy, a class or function without arguments, under a name."""
list_strategies = _STRATEGIES.names


def get_strategy(name: str) -> FusionStrategy:
    """Make the strategy of a name, one object for each agent.

    Raises:
        ConfigError: no strategy has the name.
    """
    return _STRATEGIES.get(current_name(name))()
