"""A tick among the nodes in play; and again, with those who turn out to matter."""

from dataclasses import replace

import numpy as np

from contactgraph.control.compiled_tick import CompiledTick
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.host import MeasurementReader, Motion
from contactgraph.control.in_play import (
    Surroundings,
    always_in_play,
    padded,
    room_for,
    rooms,
    staying,
)
from contactgraph.control.mpc_state import MPCState
from contactgraph.control.part import carried_over, part_of
from contactgraph.control.plan import Plan
from contactgraph.data import InvalidInputError
from contactgraph.model import InteractionCutoff, Nodes

_READY = 18
"""Nodes in play that are compiled for before a run, where no limit is given."""


class LocalTick:
    """Ticks in scenes of any size, of the nodes in play alone: see `contactgraph.control.in_play`.

    A tick whose search came near nodes that were left out is made again with them, from where it
    began. So its answer is that of a tick with all nodes.
    """

    def __init__(
        self, compiled: CompiledTick, locality: InteractionCutoff | None, most: int | None
    ) -> None:
        """``locality`` None: everyone is in play, always. ``most`` nodes may be; None: all."""
        self._compiled, self._locality, self._most = compiled, locality, most

    def begin(
        self, reader: MeasurementReader, motion: Motion, nodes: Nodes, cost: QuadraticCost
    ) -> MPCState:
        """A run's first state, with a first plan.

        Compiles, also for more in play: up to the limit, or up to `_READY`. Raises
        `InvalidInputError` where the limit is too low.
        """
        nodes, cost = self._compiled.strongly_typed((nodes, cost))
        capacity, dimension = motion[0].shape
        always = self._always(nodes, cost)
        self._check_room(len(always))
        unknown = reader.applied(None, cost.control_size)
        for room in rooms(len(always), self._most or _READY, capacity)[::-1]:
            part = part_of(nodes, cost, padded(always, room), always, dimension)
            self._compiled.warm_up(part, motion, reader.contact(None, part.who), unknown)
        first = self._compiled.first(part, motion)
        before = MPCState(nodes, cost, part, first, last_seen=motion)
        before, after, missing = self._settled(before, reader, motion, None, unknown)
        self._check_room(int(np.sum(before.who >= 0)) + len(missing))
        known = replace(before.memory, plan=after.memory.plan, swept=after.memory.swept)
        return replace(before, memory=known)

    def __call__(
        self,
        state: MPCState,
        reader: MeasurementReader,
        motion: Motion,
        contacts: np.ndarray | None,
        applied: np.ndarray,
    ) -> tuple[Plan, MPCState, bool]:
        """One tick: the plan, the state after it, and whether more nodes would have had to be in
        play than the limit allows."""
        # Not in the tick that showed who may leave: it may have been made twice, and is late.
        state = self._without_who_left(self._of_its_scene(state))
        _, after, missing = self._settled(state, reader, motion, contacts, applied)
        return after.plan, after, len(missing) > 0

    def _settled(
        self,
        state: MPCState,
        reader: MeasurementReader,
        motion: Motion,
        contacts: np.ndarray | None,
        applied: np.ndarray,
    ) -> tuple[MPCState, MPCState, np.ndarray]:
        """A tick of all who matter: the states that it began from and led to, and who of them is
        still missing, for want of room."""
        known = bool(np.isfinite(motion[0]).all() and np.isfinite(motion[1]).all())
        if not known:  # Nobody can tell who matters; to the tick it is a bad observation.
            motion = np.full_like(motion[0], np.nan), np.full_like(motion[1], np.nan)
        while True:
            part = state.part
            contact = reader.contact(contacts, part.who)
            memory = self._compiled(part, state.memory, motion, contact, applied)
            last_seen = motion if known else state.last_seen
            after = MPCState(state.nodes, state.cost, part, memory, last_seen)
            missing = part.left_out[:0]
            if known and len(part.left_out) and self._locality is not None:
                assert memory.swept is not None
                around = Surroundings.seen(part.left_out, motion)
                seen = memory.swept, part.who, part.always, self._locality
                missing = around.missing(*seen)
            if not len(missing):
                return state, after, missing
            inside = part.who[part.who >= 0]
            free = len(missing) if self._most is None else max(0, self._most - len(inside))
            joining = missing[:free]
            if not len(joining):
                return state, after, missing
            # Where there is room, those are with them who may be the next to matter.
            room = room_for(len(inside) + len(joining), len(motion[0]))
            free = min(room, self._most or room) - len(inside)
            inside = np.concatenate([inside, around.missing(*seen, reaches=2.0)[:free]])
            state = self._about(state, inside, part.who[part.always])

    def _without_who_left(self, state: MPCState) -> MPCState:
        """With less room, where the last tick showed that there is need for no more."""
        part, capacity = state.part, len(state.last_seen[0])
        if room_for(int(np.sum(part.always)), capacity) >= len(part.who):
            return state
        assert self._locality is not None and state.memory.swept is not None
        swept, seen = state.memory.swept, state.last_seen
        stay = staying(swept, part.who, part.always, seen, self._locality)
        if room_for(len(stay), capacity) >= len(part.who):
            return state
        return self._about(state, stay, part.who[part.always])

    def _of_its_scene(self, state: MPCState) -> MPCState:
        """With those in play who always are, also where the scene's nodes or cost were replaced."""
        nodes, cost = state.part.of
        if nodes is state.nodes and cost is state.cost:
            return state
        always = self._always(state.nodes, state.cost)
        self._check_room(len(always))
        before = np.intersect1d(state.who, np.flatnonzero(np.asarray(state.nodes.mask)))
        inside = np.union1d(before, always)
        if self._most is not None and len(inside) > self._most:
            inside = always  # Whoever matters besides joins again.
        return self._about(state, inside, always)

    def _about(self, state: MPCState, inside: np.ndarray, always: np.ndarray) -> MPCState:
        """The state with the nodes ``inside`` in play, of whom some are so ``always``."""
        capacity, dimension = state.last_seen[0].shape
        who = padded(inside, room_for(len(inside), capacity))
        part = part_of(state.nodes, state.cost, who, always, dimension)
        if np.array_equal(who, state.who):
            return replace(state, part=part)
        self._compiled.make_room(len(who))
        return carried_over(state, part, self._compiled.first(part, state.last_seen))

    def _always(self, nodes: Nodes, cost: QuadraticCost) -> np.ndarray:
        """[m] Nodes that are in play wherever things are."""
        if self._locality is None:
            return np.arange(len(nodes.mask))
        return always_in_play(nodes, cost)

    def _check_room(self, count: int) -> None:
        if self._most is not None and count > self._most:
            raise InvalidInputError(
                f"max_active_nodes must be at least {count} for this scene, found {self._most}"
            )
