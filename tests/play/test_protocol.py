"""A real server and real clients: wishes change the session, and nothing else gets in."""

import json
import urllib.error
import urllib.request
from contextlib import ExitStack

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from contactgraph.cli.main import run
from contactgraph.data import InvalidInputError, read_trajectories
from contactgraph.play.server import LARGEST_MESSAGE, listening_socket
from contactgraph.play.wishes import read_wish


def place(frame, node):
    return np.array(frame["position"]).reshape(-1, 2)[node]


def test_a_moved_goal_is_the_episodes_goal_and_is_reached(served, page):
    page.next_scene()
    goal = [0.11, -0.17]
    page.wish("goal", goal=goal, number=7)
    frame = page.until(lambda found: found.get("acted") == 7)
    assert frame["goal"] == goal
    ahead = np.array(frame["plan"]["position"]).reshape(frame["plan"]["horizon"] + 1, -1, 2)
    gripper = frame["plan"]["nodes"].index(0)
    assert np.ptp(ahead[:, gripper], axis=0).max() > 0.01, "the plan moves"
    frame = page.until(lambda found: found.get("reached"))
    assert frame["goal"] == goal
    assert frame["distance"] < 0.1


def test_a_pulled_body_moves_there(page):
    begin = page.next_scene()
    page.wish("pause", paused=True)
    start = place(begin, 1)
    to = start + np.where(start > 0.0, -0.4, 0.4)
    page.wish("pull", node=1, to=to.tolist())
    step = begin["step"]
    for _ in range(8):  # the gripper is far away yet
        page.wish("step")
        last, step = step, page.until(lambda found, last=step: found.get("step", last) > last)
        step = step["step"]
        assert step > last
    page.wish("release")
    page.wish("pause", paused=False)
    frame = page.until(lambda found, last=step: found.get("step", last) > last)
    assert np.linalg.norm(place(frame, 1) - to) < 0.6 * np.linalg.norm(start - to)


def test_a_broken_sensor_changes_beliefs(page):
    frame = page.next_scene()
    assert frame["contact"] == []
    assert max(frame["belief"]) < 0.01
    page.wish("sensor", sensor="broken")
    frame = page.until(lambda found: found.get("belief") and max(found["belief"]) > 0.05)
    assert frame["sensor"] == "broken"
    page.until(lambda found: found.get("contact") == [0] and found["belief"][0] < 0.5)
    page.wish("sensor", sensor="exact")
    page.until(lambda found: found.get("contact") == [0] and found["belief"][0] > 0.9)


def test_a_blind_controller_still_believes_by_motion(page):
    page.wish("sensor", sensor="blind")
    page.next_scene()
    frame = page.until(lambda found: found.get("contact") == [0])
    assert frame["sensor"] == "blind"
    assert frame["belief"][0] > 0.5


def test_time_can_be_stopped_and_told_step_by_step(page):
    page.wish("pause", paused=True)
    stopped = page.until(lambda found: found.get("paused"))
    page.wish("step")
    first = page.until(lambda found: found.get("step", 0) > stopped["step"])
    page.wish("step")
    page.until(lambda found: found.get("step") == first["step"] + 1)
    page.wish("pause", paused=False)
    page.until(lambda found: found.get("step", 0) > stopped["step"] + 4)


@pytest.mark.parametrize(
    "message",
    [
        "",
        "[1, 2]",
        "nonsense",
        b"\x00\x01",
        '{"wish": "fly"}',
        '{"wish": "goal", "goal": [1, NaN], "number": 0}',
        '{"wish": "goal", "goal": [1e9, 0], "number": 0}',
        '{"wish": "pull", "node": -1, "to": [0, 0]}',
        '{"wish": "pull", "node": 1, "to": "far"}',
        '{"wish": "speed", "speed": null}',
        "[" * 3000,
    ],
)
def test_garbage_gets_one_error_and_breaks_nothing(page, message):
    page.connection.send(message)
    error = page.until(lambda found: found["type"] == "error")
    assert "\n" not in error["text"]
    step = page.until(lambda found: "step" in found)["step"]
    page.until(lambda found: found["type"] == "error" or found.get("step", step) != step)


@pytest.mark.parametrize(
    ("wish", "words"),
    [
        ({"wish": "pull", "node": 9, "to": [0, 0]}, "nodes are 0 to 1"),
        ({"wish": "goal", "goal": [0, 0, 0], "number": 1}, "2 numbers"),
        ({"wish": "switch", "switch": "on"}, "no switch"),
        (
            {"wish": "stage", "model": "os:system@pickup", "task": "pickup", "distractors": 0},
            "lists",
        ),
        ({"wish": "stage", "model": "pickup", "task": "door", "distractors": 99}, "distractors"),
    ],
)
def test_a_wish_that_cannot_be_is_told(page, wish, words):
    page.connection.send(json.dumps(wish))
    page.until(lambda found: words in ((found.get("notice") or {}).get("text") or ""))


def test_a_message_that_is_too_large_ends_its_connection_alone(served, page):
    with served.connect() as other:
        other.send("x" * (LARGEST_MESSAGE + 1))
        with pytest.raises(ConnectionClosedError) as error:
            while True:
                other.recv(timeout=60)
    assert error.value.rcvd.code == 1009
    step = page.until(lambda found: "step" in found)["step"]
    page.until(lambda found: found.get("step", step) != step)


@pytest.mark.parametrize("origin", ["http://example.com", "http://127.0.0.1:1", None])
def test_a_foreign_origin_is_refused(served, origin):
    address = served.origin.replace("http", "ws") + "/session"
    with pytest.raises(InvalidStatus) as error:
        connect(address, origin=origin, proxy=None)
    assert error.value.response.status_code == 403


def get(url, host=None):
    request = urllib.request.Request(url, headers={"Host": host} if host else {})
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(request, timeout=60) as answer:
        return answer.read().decode()


def test_the_page_allows_its_own_script_and_connection_alone(served):
    text = get(served.origin + "/")
    policy = text.split('http-equiv="Content-Security-Policy" content="')[1].split('"')[0]
    assert policy.startswith("default-src &#x27;none&#x27;")
    assert f"connect-src {served.origin.replace('http', 'ws')}/session" in policy
    assert "//" not in policy.replace(served.origin.replace("http", "ws"), "")


@pytest.mark.parametrize(
    ("path", "host", "code"),
    [("/", "evil.example", 403), ("/session", "evil.example", 403), ("/other", None, 404)],
)
def test_another_host_or_path_is_served_nothing(served, path, host, code):
    with pytest.raises(urllib.error.HTTPError) as error:
        get(served.origin + path, host)
    assert error.value.code == code
    error.value.close()


def test_few_pages_may_be_open(served, page):
    with ExitStack() as others:
        for _ in range(3):
            others.enter_context(served.connect())
        with pytest.raises(InvalidStatus) as error:
            served.connect()
    assert error.value.response.status_code == 503


def test_finished_episodes_are_a_dataset(served, page):
    page.next_scene()
    page.wish("goal", goal=[0.0, 0.2], number=30)
    page.until(lambda found: found.get("acted") == 30)
    page.next_scene()
    written = read_trajectories(served.record)
    assert len(written) == len(served.session.trajectories)
    last = written.trajectories[-1]
    assert last.scene.goal.tolist() == [0.0, 0.2]
    assert last.scene.metadata["goal_moves"] == 1
    assert last.steps >= 1


@pytest.mark.slow
def test_another_task_is_compiled_while_this_one_goes_on(page):
    number, step = page.scene["number"], 0
    page.wish("stage", model="door", task="door", distractors=0)
    while (found := page.message()).get("task") != "door":
        step = max(step, found.get("step", 0))
        assert found.get("scene", number) >= number
    assert step > 20, "the old one went on"
    page.until(lambda found: found.get("scene") == page.scene["number"] and "step" in found)
    page.wish("stage", model="pickup", task="pickup", distractors=0)
    page.until(lambda found: found["type"] == "scene" and found["task"] == "pickup")


def test_a_taken_port_is_told():
    with (
        listening_socket(0) as taken,
        pytest.raises(InvalidInputError, match="cannot be listened on"),
    ):
        listening_socket(taken.getsockname()[1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nothing"], "name the task too"),
        (["nothing", "pickup"], "no such run folder"),
        (["pickup", "nothing"], "task must be one of"),
        (["pickup", "door"], "nodes of type door, which the model does not know"),
        (["pickup", "--port", "99999"], "--port must be"),
        (["pickup", "--record", "/nowhere/file.h5"], "does not exist"),
    ],
)
def test_a_wrong_command_ends_with_one_line(arguments, words, capsys):
    assert run(["play", *arguments]) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_speeds_are_bounded():
    assert read_wish('{"wish": "speed", "speed": 1e6}').speed == 4.0
