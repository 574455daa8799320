"""A tick among the nodes in play; and again, with those who turn out to matter."""

from dataclasses import replace

import jax
import numpy as np

from contactgraph.control.compiled_tick import CompiledTick
from contactgraph.control.cost import QuadraticCost
from contactgraph.control.in_play import (
    Surroundings,
    always_in_play,
    padded,
    room_for,
    rooms,
    staying,
)
from contactgraph.control.measurement import MeasurementReader, Motion
from contactgraph.control.mpc_state import MPCState
from contactgraph.control.part import carried_over, part_of
from contactgraph.control.plan import Plan
from contactgraph.data import InvalidInputError
from contactgraph.model import Locality, Nodes

_READY = 8
"""Nodes in play that are compiled for before a run, where no limit is given."""


class LocalTick:
    """Ticks in scenes of any size, of the nodes in play alone: see `contactgraph.control.in_play`.

    A tick whose search came near nodes that were left out is made again with them, from where it
    began. So its answer is that of a tick with all nodes.
    """

    def __init__(self, compiled: CompiledTick, locality: Locality, most: int | None) -> None:
        """``most`` nodes may be in play; None: as many as there are."""
        self._compiled, self._locality, self._most = compiled, locality, most

    def begin(
        self,
        reader: MeasurementReader,
        motion: Motion,
        nodes: Nodes,
        cost: QuadraticCost,
        always: np.ndarray,
    ) -> MPCState:
        """A run's first state, with a first plan; ``always`` are in play wherever things are.

        Compiles, also for more in play: up to the limit, or up to `_READY`. Raises
        `InvalidInputError` where the limit is too low.
        """
        nodes, cost = self._compiled.strongly_typed((nodes, cost))
        capacity, dimension = motion[0].shape

        def about(room: int) -> MPCState:
            who = padded(always, room)
            part = part_of(nodes, cost, who, always, dimension)
            state = self._compiled.first_state(*_of(who, motion), part.nodes, part.cost)
            plan = replace(state.plan, who=jax.device_put(who.astype(np.int32)))
            return replace(state, nodes=nodes, cost=cost, plan=plan, part=part, last_seen=motion)

        unknown = reader.applied(None, cost.control_size)
        for room in rooms(len(always), self._most or _READY, capacity)[::-1]:
            state = about(room)
            inputs = *_of(state.who, motion), reader.contact(None, state.who), unknown
            self._compiled.warm_up(state, *inputs)
        state, plan, after, missing = self._settled(state, reader, motion, None, unknown)
        if len(missing) or len(always) > (self._most or capacity):
            count = np.sum(state.who >= 0) + len(missing)
            raise InvalidInputError(
                f"most_in_play must be at least {count} for this scene, found {self._most}"
            )
        return replace(state, plan=plan, swept=after.swept)

    def __call__(
        self,
        state: MPCState,
        reader: MeasurementReader,
        motion: Motion,
        contacts: np.ndarray | None,
        applied: np.ndarray,
    ) -> tuple[Plan, MPCState, bool]:
        """One tick: the plan, the state after it, and whether more would have had to be in play
        than the limit allows."""
        state = self._of_its_scene(state)
        state, plan, after, missing = self._settled(state, reader, motion, contacts, applied)
        return plan, self._without_who_left(after), len(missing) > 0

    def _settled(
        self,
        state: MPCState,
        reader: MeasurementReader,
        motion: Motion,
        contacts: np.ndarray | None,
        applied: np.ndarray,
    ) -> tuple[MPCState, Plan, MPCState, np.ndarray]:
        """A tick of all who matter: the state that it began from, its answer, and who of them is
        still missing, for want of room."""
        known = all(np.isfinite(values).all() for values in motion)
        if not known:  # Nobody can tell who matters; to the tick it is a bad observation.
            motion = np.full_like(motion[0], np.nan), np.full_like(motion[1], np.nan)
        while True:
            part, who = state.part, state.who
            assert part is not None
            seen = _of(who, motion)
            contact = reader.contact(contacts, who)
            remember = motion if known else state.last_seen
            plan, after = self._compiled.tick(state, *seen, contact, applied, last_seen=remember)
            if not known:
                return state, plan, after, part.left_out[:0]
            assert after.swept is not None
            inside = who[who >= 0]
            around = Surroundings.seen(part.left_out, motion)
            missing = around.missing(after.swept, who, part.always, self._locality)
            joining = missing
            if self._most is not None:
                joining = missing[: max(0, self._most - len(inside))]
            if not len(joining):
                return state, plan, after, missing
            state = self._about(state, np.concatenate([inside, joining]))

    def _without_who_left(self, state: MPCState) -> MPCState:
        """With less room, where the tick showed that there is need for no more."""
        part, who = state.part, state.who
        assert part is not None and state.last_seen is not None and state.swept is not None
        capacity = len(state.last_seen[0])
        if room_for(int(part.always.sum()), capacity) >= len(who):
            return state
        stay = staying(state.swept, who, part.always, state.last_seen, self._locality)
        return state if room_for(len(stay), capacity) >= len(who) else self._about(state, stay)

    def _of_its_scene(self, state: MPCState) -> MPCState:
        """With those in play who always are, also where the scene's nodes or cost were replaced."""
        part, nodes = state.part, state.nodes
        assert part is not None
        if part.of[0] is nodes and part.of[1] is state.cost:
            return state
        everyone = np.flatnonzero(np.asarray(nodes.mask))
        always = always_in_play(nodes, state.cost)
        always = everyone if always is None else always
        before = np.intersect1d(state.who, everyone)
        return self._about(state, np.union1d(before, always), always)

    def _about(
        self, state: MPCState, inside: np.ndarray, always: np.ndarray | None = None
    ) -> MPCState:
        """The state with the nodes ``inside`` in play."""
        assert state.part is not None and state.last_seen is not None
        always = state.who[state.part.always] if always is None else always
        capacity, dimension = state.last_seen[0].shape
        who = padded(inside, room_for(len(inside), capacity))
        self._compiled.make_room(len(who))
        part = part_of(state.nodes, state.cost, who, always, dimension)
        new = self._compiled.first_state(*_of(who, state.last_seen), part.nodes, part.cost)
        return carried_over(state, who, part, new.belief)


def _of(who: np.ndarray, motion: Motion) -> Motion:
    """Of the nodes ``who`` [n] alone; what padding (-1) holds does not matter."""
    position, velocity = motion
    return position[who], velocity[who]
