"""The prompt of mode ``guided``: rows of sensors that begin with letters, of which the LLM is to name one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from service.prompting.candidates import CandidateSet, Letters
from service.prompting.prompt import Prompt, Template, note_block
from service.prompting.row_formats import FORMATS, Cells
from service.prompting.unpruned_baseline import Uncompressed
from shared.features import State
from shared.scenario import Scenario

_STATIC = """You direct a fleet of UAVs that collect data packets from ground sensors along a pipeline. \
At each waypoint you choose{each} one sensor to collect from and the velocity for the next {step_s:g} seconds.

Goal: lose no packets. A sensor's queue holds {capacity} packets; what arrives beyond that is lost.

{listed}Each row is one sensor, {order}: a letter, then
{number}queue,age,velocity
queue: packets waiting. age: steps since its last visit. velocity: the fastest, in m/s, at which the UAV can collect; \
the slowest before it where that is not 0.
{letters}

Rules:
1. Prefer a full queue, then a long age.
2. Fly slowly to stay near full queues, fast when there is little to collect.
{apart}
{note}{experiences}Answer with {answer} and nothing else."""

_ALONE = {"each": "", "listed": "", "number": "", "apart": "", "answer": "one letter"}
_TOGETHER = {
    "each": " for every UAV",
    "listed": "Each UAV has rows of its own, under its number. ",
    "number": "sensor,",
    "apart": "3. Never choose the same sensor for two UAVs.\n",
    "answer": "one letter for each UAV, in their order, each on a line of its own,",
}

_EXPERIENCES = "Past decisions are queue,age>velocity:cost, where 0 is the best cost.\n\n"
# Rows that say nothing of any sensor.
_CONTENT_FREE = ("N/A", "?,?,?")


class GuidedTemplate(Template):
    """The prompt of mode ``guided``; it has one format and no demonstrations.

    Args:
        scenario: the mission's world.
        rows: the most that a prompt shows.
        experiences: the most that it may hold; with 0 the static block does not speak of them.
        ranked: whether the rows come best first.
        note: the operator's.
    """

    def __init__(
        self, scenario: Scenario, *, rows: int, experiences: int, ranked: bool, note: str | None = None
    ) -> None:
        super().__init__(scenario, experiences=experiences, ranked=ranked)
        self.letters = Letters.of(rows)
        order = "the most promising first" if ranked else "in no particular order"
        named = self.letters.at(0)
        letters = (
            f"In the row that begins with {named[0]}, the letters {', '.join(named)} are its velocities, slowest to "
            "fastest; so in the other rows."
            if self.letters.velocities > 1
            else "The letter is the sensor at its fastest velocity."
        )
        said = {
            "step_s": scenario.step_s,
            "capacity": scenario.queue_capacity,
            "order": order,
            "letters": letters,
            "note": note_block(note),
            "experiences": _EXPERIENCES if experiences else "",
        }
        self.static = _STATIC.format(**said, **_ALONE)
        self.static_together = _STATIC.format(**said, **_TOGETHER)

    def experience(self, seen: Cells, sensor_id: int, velocity: int, cost: float) -> str:
        """Such as ``52,3>7:0``, the cost in tenths."""
        return f"{seen['queue']},{seen['age']}>{velocity}:{min(99, round(10 * cost))}\n"

    def offer(
        self, offer: CandidateSet, state: State, experiences: Sequence[str], nearest: Sequence[str] = ()
    ) -> Prompt:
        """The prompt for one decision, the offer's rows in their order."""
        last = "".join(nearest)
        return Prompt(
            static=self.static,
            experiences="".join(experiences),
            state=last + offer.rows,
            uncompressed=_whole(state).under(last),
        )

    def together(
        self, offers: Mapping[int, tuple[CandidateSet, State]], experiences: Sequence[str], nearest: Sequence[str] = ()
    ) -> dict[int, Prompt]:
        """Each UAV's share of one prompt about several, by number.

        The static block and the experiences are the first one's; the user message is the shares' in order.
        """
        shares = {
            uav: Prompt("", "", _list(uav, offer.numbered_rows()), _whole(state).under(_list(uav, "")))
            for uav, (offer, state) in offers.items()
        }
        uav, first = next(iter(shares.items()))
        last = "".join(nearest)
        shares[uav] = Prompt(
            static=self.static_together,
            experiences="".join(experiences),
            state=last + first.state,
            uncompressed=first.uncompressed.under(last),
        )
        return shares

    def content_free(self, uavs: Sequence[int] = ()) -> list[str]:
        """User messages with as many rows as there can be, none of which says anything; of several UAVs, by number."""
        heads = self.letters.first
        if not uavs:
            return ["".join(f"{letter}{nothing}\n" for letter in heads) for nothing in _CONTENT_FREE]
        return [
            "".join(_list(uav, "".join(f"{letter}?,{nothing}\n" for letter in heads)) for uav in uavs)
            for nothing in _CONTENT_FREE
        ]

    @property
    def labels(self) -> list[str]:
        """Every letter that a prompt of this mission can offer."""
        return list(self.letters.all)


def _whole(state: State) -> Uncompressed:
    return Uncompressed(state, FORMATS["csv"].row)


def _list(uav: int, rows: str) -> str:
    return f"UAV {uav}\n{rows}"
