"""Command line, as a person runs it."""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import av
import numpy as np
import PIL.Image
import pytest
from conftest import FRAME, GOAL, PlannerProcess
from test_recording import SPEC, frame, record

import cpn_client
from cpn.v1 import demonstration_pb2
from cpn_client import Image
from cpn_client.cli import camera

CPN = Path(sys.executable).parent / "cpn"


class Shell:
    """Runs of `cpn` by one user, with a planner's address in the environment."""

    def __init__(self, folder: Path, address: str = "") -> None:
        self._folder = folder
        self._environment = os.environ | {"XDG_DATA_HOME": str(folder / "data"), "CPN_CONNECT": address}

    def run(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        command = [CPN, *arguments]
        return subprocess.run(command, cwd=self._folder, env=self._environment, capture_output=True, text=True)

    def output(self, *arguments: str | Path) -> str:
        done = self.run(*arguments)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    def error(self, *arguments: str | Path) -> str:
        """The line of an error."""
        done = self.run(*arguments)
        assert (done.returncode, done.stdout) == (1, "")
        line, rest = done.stderr.split("\n")
        assert not rest
        return line


@pytest.fixture
def shell(tmp_path: Path, process: PlannerProcess) -> Shell:
    return Shell(tmp_path, process.zenoh)


@pytest.fixture
def alone(tmp_path: Path) -> Shell:
    """Shell without a planner."""
    return Shell(tmp_path)


def pixels(path: Path) -> bytes:
    image = PIL.Image.open(path)
    assert (image.format, image.mode, image.size) == ("PNG", "RGB", (84, 84))
    return image.tobytes()


def demonstration(path: Path) -> Path:
    """Recording from the frame of the examples to their goal."""
    episode = demonstration_pb2.RecordedEpisode(render_spec=SPEC)
    return record(path, ("/episode", episode), frame(Image.of(FRAME)), frame(Image.of(GOAL)))


def test_goal_is_kept_for_a_restarted_planner(tmp_path: Path, restartable: PlannerProcess) -> None:
    shell = Shell(tmp_path, restartable.zenoh)
    goal_id = shell.output("goal", "register", GOAL, "--name", "closed").strip()
    assert shell.output("goal", "list") == f"name    id\nclosed  {goal_id}\n"
    shell.output("goal", "show", "closed", "--out", "seen.png")
    assert pixels(tmp_path / "seen.png") == Image.of(GOAL).data
    restartable.kill()
    restartable.start()
    for goal in ("closed", goal_id):
        assert json.loads(shell.output("plan", FRAME, goal, "--json"))["goal_id"] == goal_id


def test_goal_without_a_name_has_its_ids_first_digits(shell: Shell) -> None:
    goal_id = shell.output("goal", "register", GOAL).strip()
    assert shell.output("goal", "list").split("\n")[1] == f"{goal_id[:12]}  {goal_id}"


def test_goals_of_recordings_keep_their_render_spec(shell: Shell, tmp_path: Path) -> None:
    (tmp_path / "recorded" / "drawer-close").mkdir(parents=True)
    recording = demonstration(tmp_path / "recorded" / "drawer-close" / "0.mcap")
    recorded, plain = (line.split("  ") for line in shell.output("goal", "register", "recorded", GOAL).splitlines())
    assert [recorded[1], plain[1]] == [str(recording.relative_to(tmp_path)), str(GOAL)]
    assert recorded[0] != plain[0]
    for goal in (recorded[0], recording):
        assert shell.error("plan", FRAME, goal).startswith("cpn: FAILED_PRECONDITION goal_image.render_spec: expected ")
        shell.output("goal", "show", goal, "--out", "seen.png")
        assert pixels(tmp_path / "seen.png") == Image.of(GOAL).data


def test_json_is_the_clients_plan(shell: Shell, process: PlannerProcess) -> None:
    with cpn_client.connect(process.zenoh) as planner:
        search = cpn_client.Search(iterations=3)
        expected = asdict(planner.plan(model="upn", goal=GOAL, observation=FRAME, search=search))
    for planner_options in ([], ["--planner", process.grpc]):
        options = [*planner_options, "--model", "upn", "--updates", "3", "--deadline-ms", "60000", "--json"]
        plan = json.loads(shell.output("plan", FRAME, GOAL, *options))
        for measured in ("times", "request_bytes"):
            assert plan.pop(measured)
        assert plan == {name: json.loads(json.dumps(expected[name])) for name in plan}


def test_table_has_the_plan(shell: Shell) -> None:
    actions, facts = shell.output("plan", FRAME, GOAL).split("\n\n")
    plan = json.loads(shell.output("plan", FRAME, GOAL, "--json"))
    header, *rows = (line.split() for line in actions.splitlines())
    assert header == ["step", "x", "y", "z", "gripper"]
    assert [[float(cell) for cell in row[1:]] for row in rows] == [
        [round(value, 4) for value in action] for action in plan["actions"]
    ]
    losses = " -> ".join(f"{loss:.4f}" for loss in plan["inner_losses"])
    for fact in (f"inner loss       {losses}", f"model digest     {plan['model_digest']}"):
        assert fact in facts.splitlines()


def test_observation_of_a_recording_is_its_first_frame(shell: Shell, tmp_path: Path) -> None:
    unspecified = record(tmp_path / "0.mcap", frame(Image.of(FRAME)), frame(Image.of(GOAL)))
    recorded, files = (
        json.loads(shell.output("plan", *pictures, "--json"))["actions"]
        for pictures in ((unspecified, unspecified), (FRAME, GOAL))
    )
    assert recorded == files


def test_drawing_has_observation_goal_and_actions(shell: Shell, tmp_path: Path) -> None:
    shell.output("plan", FRAME, GOAL, "--draw", "plan.png")
    drawn = np.asarray(PIL.Image.open(tmp_path / "plan.png"))
    for left, image in ((30, FRAME), (30 + 252 + 30, GOAL)):
        shown = drawn[30 : 30 + 252, left : left + 252][1::3, 1::3]
        assert shown.tobytes() == Image.of(image).data
    chart = drawn[:, 2 * (252 + 30) + 30 :].reshape(-1, 3)
    for colour in ((214, 39, 40), (44, 160, 44), (31, 119, 180)):
        assert (chart == colour).all(1).sum() > 100


def test_models_are_those_of_the_folder(shell: Shell) -> None:
    header, *rows = shell.output("models").splitlines()
    assert header.split() == ["name", "method", "version", "horizon", "training", "tasks", "digest"]
    assert [row.split()[:5] for row in rows if row.startswith(("cpn", "random"))] == [
        ["cpn", "cpn", "0", "5", "20"],
        ["cpn-position", "cpn", "0", "5", "20"],
        ["random", "random", "0", "1", "0"],
    ]


def test_shown_goal_is_padded_or_cropped(alone: Shell, tmp_path: Path) -> None:
    wide = np.full((100, 200, 3), 255, np.uint8)
    PIL.Image.fromarray(wide).save(tmp_path / "wide.png")
    for options, corner in (([], 0), (["--resize", "crop"], 255)):
        alone.output("goal", "show", "wide.png", "--out", "seen.png", *options)
        assert pixels(tmp_path / "seen.png")[0] == corner


@pytest.mark.parametrize(
    ("arguments", "field", "got"),
    [
        (["goal", "register"], "IMAGES", "none"),
        (["goal", "register", "a.png", "--camera", "0"], "IMAGES", "both"),
        (["goal", "register", "none.png"], "IMAGES", "none.png: No such file or directory"),
        (["goal", "register", "broken.png"], "IMAGES", "broken.png: unrecognized data stream contents"),
        (["goal", "register", "cut.png"], "IMAGES", "cut.png: image file is truncated"),
        (["goal", "register", "header.png"], "IMAGES", "header.png: Truncated IHDR chunk"),
        (["goal", "register", "text.mcap"], "IMAGES", "text.mcap: expected a recording, an MCAP file, got Inv"),
        (["goal", "register", "empty"], "IMAGES", "empty without"),
        (["goal", "register", GOAL, "--name", "../a"], "--name", "'../a'"),
        (["goal", "register", GOAL, FRAME, "--name", "a"], "--name", "2 goals"),
        (["goal", "register", "--camera", "64"], "--camera", "[Errno 2] No such file or directory: '/dev/video64'"),
        (["goal", "register", "--camera", "/dev/null"], "--camera", "[Errno 25]"),
        (["goal", "show", "nobody", "--out", "a.png"], "GOAL", "nobody"),
        (["goal", "show", GOAL, "--out", "none/a.png"], "--out", "[Errno 2] No such file or directory: "),
        (["plan", "none.png", GOAL], "OBSERVATION", "none.png: No such file or directory"),
        (["plan", FRAME, "none.png"], "GOAL", "none.png"),
        (["plan", FRAME, GOAL, "--updates", "1001"], "--updates", "1001"),
        (["plan", FRAME, GOAL, "--deadline-ms", "0"], "--deadline-ms", "0"),
        (["models", "--planner", "here"], "address", "'here'"),
        (["models", "--tls-certificate", "a"], "--tls-ca", "none"),
        (["models", "--token-file", "none"], "--token-file", "[Errno 2] No such file or directory: 'none'"),
    ],
)
def test_wrong_arguments_are_named(
    alone: Shell, tmp_path: Path, arguments: list[str | Path], field: str, got: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.mcap").write_text("no recording")
    data = bytearray(GOAL.read_bytes())
    (tmp_path / "cut.png").write_bytes(data[: len(data) // 2])
    (tmp_path / "header.png").write_bytes(data[:11] + bytes([1]) + data[12:])
    data[len(data) // 2] ^= 1
    (tmp_path / "broken.png").write_bytes(data)
    line = alone.error(*arguments)
    assert line.startswith(f"cpn: {field}: expected ")
    assert f", got {got}" in line


def test_refusals_and_outages_are_one_line(shell: Shell) -> None:
    assert shell.error("plan", FRAME, GOAL, "--model", "nobody").startswith("cpn: NOT_FOUND model: expected ")
    unreachable = shell.error("plan", FRAME, GOAL, "--planner", "tcp/127.0.0.1:1")
    assert unreachable.startswith("cpn: tcp/127.0.0.1:1: expected a zenoh router or planner, got ")


def test_file_that_is_no_goal_is_named_and_left_out(alone: Shell, tmp_path: Path) -> None:
    folder = tmp_path / "data" / "cpn" / "goals"
    folder.mkdir(parents=True)
    (folder / "copied.png").write_bytes(GOAL.read_bytes())
    done = alone.run("goal", "list")
    reason = f"{folder}/copied.png: expected a registered goal, got an image without the text 'id'"
    assert (done.returncode, done.stdout, done.stderr) == (0, "name  id\n", f"cpn: {reason}; left out\n")
    assert alone.error("goal", "show", "copied", "--out", "seen.png") == f"cpn: {reason}"


def test_goal_of_a_camera_is_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """FFmpeg's test pattern, a device of its own, stands in for a webcam."""
    opened = av.open

    def pattern(path: str, format: str) -> object:  # noqa: A002
        assert (path, format) == ("/dev/video3", "v4l2")
        return opened("testsrc=size=640x480", format="lavfi")

    monkeypatch.setattr(av, "open", pattern)
    frame = camera.grab("3")
    assert (frame.mode, frame.size) == ("RGB", (640, 480))
    assert len(np.unique(np.asarray(frame).reshape(-1, 3), axis=0)) > 8


def test_missing_extra_is_named() -> None:
    without = "import sys; sys.modules['tyro'] = None; from cpn_client.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", without], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (1, "cpn: needs tyro: pip install 'cpn-client[cli]'\n")


def test_closed_output_ends_quietly() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([CPN, "plan", "--help"], stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")
