"""Mistakes that earlier implementations of the baselines made, as tabular learners."""

from __future__ import annotations

from tabular import Lesson, Table, Tabular


class CopiedReward(Tabular):
    """Every DFA state is paid what the real step was paid."""

    def lessons(self, active: str, q: int, symbol: int) -> list[Lesson]:
        real = self.lesson(active, q, symbol).reward
        return [each._replace(reward=real) for each in super().lessons(active, q, symbol)]


class RealEnd(Tabular):
    """Every DFA state ends where the real episode ends."""

    def lessons(self, active: str, q: int, symbol: int) -> list[Lesson]:
        ended = self.delta[q][symbol] in self.terminal
        return [
            each._replace(heir=None if ended else each.heir or each.role) for each in super().lessons(active, q, symbol)
        ]


class NoTerminalCounterfactuals(Tabular):
    """What would have ended an episode is not learned, unless it did."""

    def lessons(self, active: str, q: int, symbol: int) -> list[Lesson]:
        return [
            each
            for each in super().lessons(active, q, symbol)
            if each.heir is not None or (each.role, each.q) == (active, q)
        ]


class ShiftedState(Tabular):
    """What was computed for a DFA state is stored for the next one."""

    def updated_table(self, lesson: Lesson) -> Table:
        return self.table(lesson.role, (lesson.q + 1) % self.task.dfa.states)


class CutAtChange(Tabular):
    """Nothing follows a change of the DFA state."""

    def lesson(self, name: str, q: int, symbol: int) -> Lesson:
        lesson = super().lesson(name, q, symbol)
        return lesson._replace(heir=None) if lesson.q_next != q else lesson


class LeavingModule(Tabular):
    """The module that is left values the state that it leads to."""

    def following_table(self, lesson: Lesson) -> Table | None:
        return None if lesson.heir is None else self.table(lesson.role, lesson.q)


class ActiveOptionOnly(Tabular):
    """Only the option that acts learns from a step."""

    def lessons(self, active: str, q: int, symbol: int) -> list[Lesson]:
        return [each for each in super().lessons(active, q, symbol) if each.role == active]


class WrongExitGoesOn(Tabular):
    """An option goes on after a transition that is not its own, be it into an error."""

    def lesson(self, name: str, q: int, symbol: int) -> Lesson:
        lesson = super().lesson(name, q, symbol)
        wrong = lesson.q_next != q and not self.method.role(name).tables.target[q, lesson.q_next]
        return lesson._replace(heir=name, q_next=q) if wrong else lesson
