"""The robots' experts from the command line: pictures, pages and refusals."""

import base64
import dataclasses
import functools
import json
import pathlib
import re
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chromium import PROGRAM, Chromium
from commands import failure_of
from PIL import Image

import configs
from envs_mjx import registry
from envs_mjx.grid import HeavenHell
from envs_mjx.robot import film, page
from envs_mjx.robot.task import RobotState, RobotTask
from mijax import evaluate, evaluate_robot

VIEWER = pathlib.Path(__file__).resolve().parents[1] / ".cache" / "viewer" / "node_modules"
LIBRARY = "export const x = 1; // import {y} from './animator.js'"


@pytest.fixture(scope="module", params=configs.ROBOTS)
def moment(request: pytest.FixtureRequest) -> tuple[RobotTask, RobotState]:
    env = registry.make(request.param)
    assert isinstance(env, RobotTask)
    return env, jax.device_get(env.reset(jax.random.key(0))[0])


failure = functools.partial(failure_of, evaluate.main)


@pytest.mark.parametrize(("arguments", "message"), [
    ((), "got no run folder, accepted: one, or --planner or --random"),
    (("--planner",), "--planner: got True, accepted: with --domain, one of block_pulling, block_pushing, drawer"),
    (("--random",), "--random: got True, accepted: with --domain"),
    (("runs/x", "--planner", "--domain", "block_pulling"), "--planner: got 'runs/x', accepted: no run folder"),
    (("runs/x", "--domain", "block_pulling"), "--domain: got 'block_pulling', accepted: with --planner only"),
    (("runs/x", "--html"), "--html: got 'True', accepted: with --planner only"),
    (("--planner", "--random", "--domain", "block_pulling"), "--planner or --random, not both"),
    (("--planner", "--domain", "sphinx"), "--domain: got 'sphinx', accepted: with --planner a robot task: block_pul"),
    (("--planner", "--domain", "mars"), "unknown domain 'mars'"),
    (("--planner", "--domain", "block_pulling", "--seeds", "2"), "--seeds: got '2', accepted: with a run only"),
    (("--planner", "--domain", "block_pulling", "--text"), "--text: got True, accepted: with a run only"),
    (("--random", "--domain", "block_pulling", "--gif"), "without --gif"),
    (("--planner", "--domain", "block_pulling", "--episodes", "0"), "--episodes: got 0"),
    (("--planner", "--domain", "block_pulling", "--html", "--viewer-libraries", "nowhere"), "`make viewer` installs"),
])
def test_what_does_not_go_together_is_named(
    arguments: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert message in failure(capsys, *arguments)


def test_a_robot_is_known_by_its_type(moment: tuple[RobotTask, RobotState]) -> None:
    """An environment of a user's own may have physics as well."""
    other = HeavenHell()
    vars(other)["physics"] = "of its own"
    assert evaluate_robot.is_robot(moment[0])
    assert not evaluate_robot.is_robot(other)


def test_pictures_of_an_episode(moment: tuple[RobotTask, RobotState]) -> None:
    env, env_state = moment
    later = dataclasses.replace(env_state, time=jnp.int32(7), outcome=jnp.int32(1))
    plain = film.frames(env, [env_state, later], None)
    beside = film.frames(env, [env_state], np.full((1, film.SIDE, film.SIDE, 3), 77, np.uint8))
    assert plain[0].shape[1] < beside[0].shape[1]
    assert (plain[0] != plain[1]).any()  # the caption
    depth = np.asarray(env.render(env_state)[0])[..., 0]
    panel = plain[0][22 : 22 + film.SIDE : 3, : film.SIDE : 3, 0]
    np.testing.assert_allclose(panel, 255 * (1 - depth / 0.31), atol=1)
    assert (beside[0][22 : 22 + film.SIDE, -film.SIDE :] == 77).all()


def test_the_page_has_everything_inside(moment: tuple[RobotTask, RobotState], tmp_path: pathlib.Path) -> None:
    env, env_state = moment
    for place in page.MODULES.values():
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text(LIBRARY)
    text = page.page(env, [env_state], page.load_scripts(tmp_path))
    assert "http" not in text
    imports = json.loads(text.split('importmap">')[1].split("<")[0])["imports"]
    assert {*page.MODULES, "brax/viewer.js", "brax/system.js"} <= set(imports)
    for url in (url for name, url in imports.items() if name.startswith("brax/")):
        script = base64.b64decode(url.removeprefix("data:text/javascript;base64,")).decode()
        assert set(re.findall(r"^(?:import|export) .*from '([^']+)'", script, re.MULTILINE)) <= set(imports)
    shown = json.loads(text.split('id="system">')[1].split("</script>")[0])
    gripper = shown["geoms"]["gripper"][0]["link_idx"]
    np.testing.assert_allclose(shown["states"]["x"][0]["pos"][gripper], env_state.qpos[:3], atol=1e-6)
    assert {name.split("_")[0] for name in shown["geoms"]} == {"gripper", "loose", "fixed", "world"}
    assert len(shown["geoms"]["world"]) == (2 if env.name == "block_pushing" else 1)
    (tmp_path / page.MODULES["three"]).unlink()
    with pytest.raises(page.ViewerMissing, match="make viewer"):
        page.load_scripts(tmp_path)


@pytest.mark.skipif(PROGRAM is None or not VIEWER.is_dir(), reason="needs Chromium and `make viewer`")
def test_a_browser_draws_the_page(moment: tuple[RobotTask, RobotState], tmp_path: pathlib.Path) -> None:
    """Without complaint, or asking for more; both objects, in red and in blue, are in sight."""
    env, env_state = moment
    (tmp_path / "page.html").write_text(page.page(env, [env_state], page.load_scripts(VIEWER)))
    browser = Chromium(tmp_path / "profile")
    browser.resize(800, 600)
    browser.open(tmp_path / "page.html")
    red = blue = 0
    deadline = time.monotonic() + 60
    while min(red, blue) < 1000 and time.monotonic() < deadline:
        browser.screenshot(tmp_path / "page.png")
        with Image.open(tmp_path / "page.png") as image:
            colours = np.asarray(image.convert("RGB"), np.int32)
        red, blue = (int((colours[..., one] > colours[..., other] + 40).sum()) for one, other in ((0, 2), (2, 0)))
    assert min(red, blue) >= 1000
    assert browser.complaints == []
    assert [url for url in browser.requests if not url.startswith(("file:", "data:"))] == []
    browser.close()


@pytest.mark.slow
@pytest.mark.parametrize("domain", configs.ROBOTS)
def test_the_expert_from_the_command_line(
    domain: str, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pictures"
    assert evaluate.main(["--planner", "--domain", domain, "--episodes", "32", "--gif", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert [line.split()[-4] for line in said.splitlines() if line.startswith(("the ", "either"))] == ["16", "16", "32"]
    with Image.open(out / "planner.gif") as image:
        assert 5 <= getattr(image, "n_frames", 1) <= 51
    assert evaluate.main(["--random", "--domain", domain, "--episodes", "32"]) == 0
    said = capsys.readouterr().out
    assert "not finite 0" in said
    assert "a number that is not finite: 0" in said
