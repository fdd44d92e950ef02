# SPDX-License-Identifier: Apache-2.0
"""The rows of a table of methods: strategies with the weights of the study, and baselines with weights of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from manyeyes.agents.strategies.names import TEMPORAL, current_name, form_of
from manyeyes.agents.strategies.registry import get_strategy, list_strategies
from manyeyes.agents.token_codec import has_token_history
from manyeyes.datatypes import ConfigError
from manyeyes.evaluation.detection.benchmark import BenchmarkConfig, load_detector
from manyeyes.models.detector.protocols import BoxDetector
from manyeyes.pose.registry import load_corrector
from manyeyes.studies.engine.conditions import Condition, ResultKey
from manyeyes.studies.engine.replay_study import FORMS, OURS

CHECKPOINT_SYNTAX = "NAME=weights.safetensors[@STRATEGY[@CORRECTOR]]"


@dataclass(frozen=True)
class Contender:
    """A row of a table. name: in tables, with the end of its form. method: the strategy. weights: of its own; None: those of the
    study. corrector: the pose corrector that is part of the method; None: that of the condition.
    """

    name: str
    method: str
    weights: str | None = None
    corrector: str | None = None

    @property
    def form(self) -> str:
        """The end of its name that states its form."""
        return form_of(self.method)

    @property
    def group(self) -> str:
        """What its conditions begin with; empty for the weights of the study. The forms of a baseline are one group."""
        return "" if self.weights is None else self.name.removesuffix(TEMPORAL)

    def key(self, condition: str) -> ResultKey:
        """Return the key of its result under a condition."""
        return f"{self.group}: {condition}" if self.group else condition, self.method

    def load_detector(self, base: BenchmarkConfig) -> BoxDetector:
        """Load its weights, by default those of the study."""
        return load_detector(base.weights if self.weights is None else self.weights)


def list_contenders(methods: Sequence[str], checkpoints: Sequence[str] = (), study: str = "") -> tuple[Contender, ...]:
    """Return the methods, then the baselines in the forms in which intermediate fusion is among the methods.

    A baseline without token history (mode bare) has the form without memory alone. checkpoints: words of CHECKPOINT_SYNTAX; the
    strategy, without the end of its form, is ``intermediate`` by default.

    Raises:
        ConfigError: a word is not of the syntax, a name is that of a strategy or occurs twice, or a file is no weights.
    """
    forms = tuple(form for form in FORMS if OURS + form in methods)
    baselines = [_parse_checkpoint(word, study) for word in checkpoints]
    names = [name for name, _, _, _ in baselines]
    if taken := sorted(set(names) & set(list_strategies())):
        raise ConfigError(
            f"The study '{study}' has methods of the names {', '.join(taken)}; name these baselines otherwise."
        )
    if len(set(names)) < len(names):
        raise ConfigError(f"The study '{study}' takes --checkpoints {CHECKPOINT_SYNTAX} ..., each name once.")
    out = [Contender(method, method) for method in methods]
    for name, weights, strategy, corrector in baselines:
        has_memory = has_token_history(load_detector(weights))
        for form in (form for form in forms if has_memory or not form):
            get_strategy(strategy + form)
            out.append(Contender(name + form, strategy + form, weights, corrector))
    return tuple(out)


def _parse_checkpoint(word: str, study: str) -> tuple[str, str, str, str | None]:
    """Return name, weights, strategy without the end of its form, and pose corrector of a word of CHECKPOINT_SYNTAX."""
    name, _, rest = word.partition("=")
    weights, *more = rest.split("@")
    if not name or not weights or len(more) > 2:
        raise ConfigError(
            f"The study '{study}' takes --checkpoints {CHECKPOINT_SYNTAX} ..., each name once; got {word}."
        )
    strategy, corrector = (*more, "", "")[:2]
    if corrector:
        load_corrector(corrector)
    return name, weights, current_name(strategy or OURS).removesuffix(TEMPORAL), corrector or None


def select_contenders(contenders: Sequence[Contender], names: Sequence[str], study: str) -> tuple[Contender, ...]:
    """Return the contenders of these names; all of them without names."""
    unknown = sorted(set(names) - {contender.name for contender in contenders})
    if unknown:
        known = ", ".join(contender.name for contender in contenders)
        raise ConfigError(f"The study '{study}' has no row {unknown[0]!r}; its rows are {known}.")
    return tuple(contender for contender in contenders if not names or contender.name in names)


def make_conditions(
    contenders: Sequence[Contender], list_settings: Callable[[Contender], Sequence[tuple[str, BenchmarkConfig]]]
) -> list[Condition]:
    """Return the conditions of all contenders, those of equal weights together, so that each cloud is processed once for them.

    list_settings: names and configurations of the conditions of a contender, the same for all of one group and corrector.
    """
    groups: dict[tuple[str, str | None], list[Contender]] = {}
    for contender in contenders:
        groups.setdefault((contender.group, contender.corrector), []).append(contender)
    out = []
    for members in groups.values():
        first, methods = members[0], tuple(contender.method for contender in members)
        for name, config in list_settings(first):
            own = config if first.weights is None else replace(config, weights=first.weights)
            out.append(Condition(first.key(name)[0], replace(own, methods=methods)))
    return out
