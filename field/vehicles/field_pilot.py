"""The pilot of real UAVs: each asks the edge, all at once, and decides on board while the edge is silent."""

import asyncio
from collections.abc import Callable, Mapping
from types import MappingProxyType

from shared.client.calls import Exchange
from shared.client.edge_client import AsyncEdgeClient
from shared.client.errors import EdgeError, EdgeRefused
from shared.wire.missions import MissionStatus
from shared.wire.schemas import DecideRequest, FeedbackRequest, MissionSpec, Mode, Outcome
from shared.world.scenario import Scenario
from simulator.errors import UsageError
from simulator.flying.pilots import OnBoard, PilotChoice, reason_on_board
from simulator.world.observation import Observation, decide_request


class FieldPilot:
    """Decides for the UAVs of one mission.

    Args:
        client: of the edge.
        mission_id: of the mission at the edge; UAVs of other commands may fly in it too.
        scenario: the mission's world.
        patience_s: after this time without an answer a UAV decides on board.
        mode: of a mission that the edge does not have yet.
        deadline_ms: the edge's, for each decision.

    Attributes:
        spec: the mission to make at the edge.
        mode: the mission's, once this command or the edge has given it.
        on_request: called with each request before it is sent.
        last_error: the text of the last failure of asking the edge.
    """

    def __init__(
        self,
        client: AsyncEdgeClient,
        mission_id: str,
        scenario: Scenario,
        patience_s: float,
        mode: Mode | None = None,
        deadline_ms: int | None = None,
    ) -> None:
        self.spec = MissionSpec(scenario=scenario, mode=mode)
        self.mode = mode
        self.on_request: Callable[[DecideRequest], None] = lambda request: None
        self.last_error: str | None = None
        self._client, self._mission_id, self._scenario = client, mission_id, scenario
        self._patience_s, self._deadline_ms = patience_s, deadline_ms
        self._on_board = OnBoard(scenario, 0)
        self._pending_outcomes: dict[int, Outcome] = {}
        # Outcomes sent to an edge that could not write them to disk; they are sent again at the end.
        self._unstored_outcomes: list[Outcome] = []
        self._joined = False

    async def join(self) -> MissionStatus:
        """Find the mission at the edge, or make it.

        Raises:
            UsageError: the mission that is there has another world or mode.
            EdgeError: the edge cannot be reached, or refuses.
        """
        try:
            there = await self._client.mission(self._mission_id)
        except EdgeRefused as refused:
            if refused.status != 404:
                raise
            there = await self._client.put_mission(self._mission_id, self.spec)
        if there.scenario != self._scenario:
            raise UsageError(
                f"--mission {self._mission_id}: the edge has this mission for another world ({there.scenario.name}); "
                "give its --world, or another ID"
            )
        if self.spec.mode is not None and there.mode != self.spec.mode:
            raise UsageError(f"--mission {self._mission_id}: the edge has it in mode {there.mode}; leave out --mode")
        self._joined, self.mode = True, there.mode
        return there

    async def decide(
        self,
        observations: Mapping[int, Observation],
        of_itself: Mapping[int, Mapping[str, float]] = MappingProxyType({}),
    ) -> dict[int, PilotChoice]:
        """The choices for UAVs from their observations, in the order of the UAVs: the edge's, or the fallback's.

        Args:
            of_itself: by UAV, further fields of its report.
        """
        answers = await asyncio.gather(
            *(self._answer(uav, seen, of_itself.get(uav, {})) for uav, seen in observations.items())
        )
        choices = {
            uav: found for uav, found in zip(observations, answers, strict=True) if isinstance(found, PilotChoice)
        }
        for (uav, seen), found in zip(observations.items(), answers, strict=True):
            if not isinstance(found, PilotChoice):
                taken = frozenset(choice.sensor for choice in choices.values())
                choices[uav] = self._on_board.decide(uav, seen, taken, found)
        return dict(sorted(choices.items()))

    def learn(self, uav: int, choice: PilotChoice, cost: float, failed: bool) -> None:
        """Store the outcome for this UAV's next request."""
        if choice.exchange is not None:
            self._pending_outcomes[uav] = choice.exchange.outcome(cost, failed)

    async def land(self) -> None:
        """Send the outcomes that no later request carried, for as long as the patience lasts."""
        try:
            async with asyncio.timeout(self._patience_s):
                for outcome in (*self._unstored_outcomes, *self._pending_outcomes.values()):
                    request = FeedbackRequest(mission_id=self._mission_id, **outcome.model_dump())
                    try:
                        await self._client.feedback(request)
                    except EdgeRefused as refused:
                        self.last_error = str(refused)
        except (EdgeError, TimeoutError) as error:
            self.last_error = str(error) or f"no answer within {self._patience_s:g} s"

    async def _answer(self, uav: int, observation: Observation, of_itself: Mapping[str, float]) -> PilotChoice | str:
        """The edge's choice, or the reason why there is none."""
        outcome = self._pending_outcomes.get(uav)
        try:
            request = decide_request(uav, observation, self._mission_id, deadline_ms=self._deadline_ms, outcome=outcome)
            request = request.model_copy(update=dict(of_itself))
            self.on_request(request)
            async with asyncio.timeout(self._patience_s):
                exchange = await self._ask(request)
        except (EdgeError, UsageError, TimeoutError, ValueError) as error:
            self.last_error = str(error) or f"no answer within {self._patience_s:g} s"
            # An edge that comes back may have lost the mission.
            self._joined = False
            return reason_on_board(error)
        answer = exchange.response
        self._on_board.follow(uav, answer.velocity)
        if outcome is not None and self._pending_outcomes.pop(uav, None) is not None and not answer.stored:
            self._unstored_outcomes.append(outcome)
        return PilotChoice(answer.sensor_id, answer.velocity, answer.source, answer.reason, exchange)

    async def _ask(self, request: DecideRequest) -> Exchange:
        if not self._joined:
            await self.join()
        try:
            exchange = await self._client.decide(request)
        except EdgeRefused as refused:
            # An edge that lost its store knows neither the mission nor the earlier decision, but it can still decide.
            # The mission of this ID that it has since may have other sensors.
            if not (refused.mission_unknown or refused.concerns("outcome") or refused.concerns("sensors")):
                raise
            self._pending_outcomes.pop(request.uav_id, None)
            await self.join()
            exchange = await self._client.decide(request.model_copy(update={"outcome": None}))
        return exchange.within(self._scenario)
