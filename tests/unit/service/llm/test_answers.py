import pytest

from service.llm.answers import NoDecision, check_answer
from service.llm.request_bodies import constrain


@pytest.mark.parametrize(
    ("text", "decision"),
    [
        ("3 7", (3, 7)),
        (" 3 14\n", (3, 14)),
        ('{"sensor_id": 3, "velocity": 0}', (3, 0)),
        ('{"why": 1, "sensor_id": 3, "velocity": 7}', (3, 7)),
    ],
)
def test_accepts_two_admissible_integers(text: str, decision: tuple[int, int]) -> None:
    assert check_answer(text, [3, 9], 15) == decision


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "answer_format"),
        ("3", "answer_format"),
        ("3 7 1", "answer_format"),
        ("3,7", "answer_format"),
        ("I choose 3 7", "answer_format"),
        ("3 7.", "answer_format"),
        ("3 -1", "answer_format"),
        ("٣ ٧", "answer_format"),
        ("3 7\n3 7", "answer_format"),
        ("99999999999 7", "answer_format"),
        ('{"sensor_id": 3}', "answer_format"),
        ('{"sensor_id": true, "velocity": 7}', "answer_format"),
        ('{"sensor_id": "3", "velocity": 7}', "answer_format"),
        ('{"sensor_id": 3, "velo', "answer_format"),
        ("{" * 100_000, "answer_format"),
        ("4 7", "answer_sensor"),
        ("3 15", "answer_velocity"),
    ],
)
def test_rejects_everything_else_and_says_why(text: str, reason: str) -> None:
    with pytest.raises(NoDecision) as caught:
        check_answer(text, [3, 9], 15)
    assert caught.value.reason == reason


def test_constraints_list_just_what_is_admissible() -> None:
    assert constrain("grammar", [3, 9], 2) == {"grammar": 'root ::= ("3" | "9") " " ("0" | "1")'}
    assert constrain("structured_outputs", [3, 9], 2) == {"structured_outputs": {"regex": "(3|9) (0|1)"}}
    schema = constrain("json_schema", [3, 9], 2)["response_format"]["json_schema"]["schema"]
    assert schema["properties"]["sensor_id"]["enum"] == [3, 9]
    assert constrain("none", [3, 9], 2) == {}
