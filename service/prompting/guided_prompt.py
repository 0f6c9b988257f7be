"""The prompt of mode ``guided``: rows of sensors with choice letters, one of which is the LLM's answer."""

from collections.abc import Mapping, Sequence

from service.prompting.candidates import CandidateSet, Letters, Viewpoint
from service.prompting.paper_prompt import STATIC_BLOCKS, Template
from service.prompting.prompt import Prompt, note_block
from service.prompting.rows import Cells, cells
from service.prompting.unpruned_state import UnprunedState
from shared.features.augmented_state import Reach, State
from shared.world.scenario import Scenario
from shared.world.step_rule import Action

_ONE_UAV = {"each": "", "listed": "", "number": "", "apart": "", "answer": "one letter"}
_FLEET = {
    "each": " for every UAV",
    "listed": "Each UAV has rows of its own, under its number. ",
    "number": "sensor,",
    "apart": "3. Never choose the same sensor for two UAVs.\n",
    "answer": "one letter for each UAV, in their order, each on a line of its own,",
}

_EXPERIENCES = "Past decisions are queue,age>velocity:cost, where 0 is the best cost.\n\n"
# Rows without information about any sensor.
_CONTENT_FREE = ("N/A", "?,?,?")


class GuidedTemplate(Template):
    """The prompt of mode ``guided``; it has one format.

    Attributes:
        labels: every choice letter of the mission's prompts.

    Args:
        scenario: the mission's world.
        rows: the most rows of a prompt.
        experiences: the most experiences of a prompt; with 0 the static block does not mention them.
        ranked: whether the rows are ordered best first.
        note: the operator's note.
    """

    # The exponent of the LLM's probabilities of the labels.
    sharpness = 1.0

    def __init__(
        self, scenario: Scenario, *, rows: int, experiences: int, ranked: bool, note: str | None = None
    ) -> None:
        super().__init__(scenario, experiences=experiences, ranked=ranked)
        self.letters = Letters.of(rows)
        self.labels = list(self.letters.all)
        order = "the most promising first" if ranked else "in no particular order"
        first_row = self.letters.of_row(0)
        letters = (
            f"In the row that begins with {first_row[0]}, the letters {', '.join(first_row)} are its velocities, "
            "slowest to fastest; so in the other rows."
            if self.letters.velocities > 1
            else "The letter is the sensor at its fastest velocity."
        )
        fields = {
            "step_s": scenario.step_s,
            "capacity": scenario.queue_capacity,
            "order": order,
            "letters": letters,
            "note": note_block(note),
            "experiences": _EXPERIENCES if experiences else "",
        }
        self.static = STATIC_BLOCKS["guided"].format(**fields, **_ONE_UAV)
        self.fleet_static = STATIC_BLOCKS["guided"].format(**fields, **_FLEET)

    def experience(self, seen: Cells, action: Action, cost: float, failed: bool) -> str:
        """A line such as ``52,3>7:0``, with the cost in tenths."""
        return f"{seen['queue']},{seen['age']}>{action.velocity}:{min(99, round(10 * cost))}\n"

    def candidates(
        self, state: State, seen: Reach, offered: Reach, shown: Sequence[int], view: Viewpoint
    ) -> CandidateSet:
        """The candidates for these rows of a state, in this order.

        Args:
            seen: the reach that the compact prompt's rows show.
            offered: the reach that the velocities are chosen by.
        """

        def write(rows: Sequence[int], letters: str, options: Sequence[Sequence[int]]) -> str:
            text = ""
            for letter, cell, own in zip(letters, cells(state, rows), options, strict=True):
                # Omitting a slowest velocity of 0, as in most rows, saves two tokens.
                span = f"{own[0]}-{own[-1]}" if 0 < own[0] < own[-1] else own[-1]
                text += f"{letter}{cell['queue']},{cell['age']},{span}\n"
            return text

        return CandidateSet.of(state, offered, shown, self.letters, view, write)

    def choice_prompt(self, candidates: CandidateSet, state: State, experiences: Sequence[str]) -> Prompt:
        """The prompt for one decision; the parameters are those of :meth:`Template.prompt`."""
        return Prompt(self.static, "".join(experiences), candidates.rows, UnprunedState(state))

    def fleet_prompts(
        self, uavs: Mapping[int, tuple[CandidateSet, State]], experiences: Sequence[str]
    ) -> dict[int, Prompt]:
        """One prompt about several UAVs, as each UAV's share of it by UAV.

        The first share has the static block and the experiences. The user message joins the shares' user messages.
        """
        shares = {}
        for uav, (candidates, state) in uavs.items():
            unpruned = UnprunedState(state, _list(uav, ""))
            shares[uav] = Prompt("", "", _list(uav, candidates.numbered_rows()), unpruned)
        uav, first = next(iter(shares.items()))
        shares[uav] = Prompt(self.fleet_static, "".join(experiences), first.state, first.uncompressed)
        return shares

    def content_free(self, uavs: Sequence[int] = ()) -> list[str]:
        """Content-free user messages with the most rows that a prompt can have, to calibrate the LLM's bias.

        Args:
            uavs: the UAVs of a prompt about several; empty for a prompt about one.
        """
        letters = self.letters.first
        if not uavs:
            return ["".join(f"{letter}{nothing}\n" for letter in letters) for nothing in _CONTENT_FREE]
        return [
            "".join(_list(uav, "".join(f"{letter}?,{nothing}\n" for letter in letters)) for uav in uavs)
            for nothing in _CONTENT_FREE
        ]


def _list(uav: int, rows: str) -> str:
    return f"UAV {uav}\n{rows}"
