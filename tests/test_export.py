"""Exported policies act as the agents they were made of, in every format, and say what they need."""

import dataclasses
import functools
import json
import pathlib
import shutil
import subprocess
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from commands import failure_of
from compass import Compass, CompassState

from envs_mjx import registry
from envs_mjx.base import ArraySpec, ContinuousActions, Environment, Interface, TimeStep
from mijax import export
from mijax.agents.core import Agent
from mijax.agents.factory import make_agent
from mijax.checkpoint import Checkpoints
from mijax.config import BelieverConfig, Config, DQNConfig, EvaluationConfig, NetworkConfig, Stage1Config
from mijax.deploy import numpy_policy, parity, trace
from mijax.deploy.numpy_policy import FILES, NEXT, Policy, PolicyError, Program, Refused
from mijax.deploy.step import contract, observation_range, policy_step
from mijax.learner import make_learner
from mijax.run_folder import RunError, RunFolder
from mijax.seeds import training_key
from mijax.trained import Training
from mijax.types import Params

pytestmark = pytest.mark.lenient

CONFIG = Config(
    stage1=Stage1Config(features=4), believer=BelieverConfig(samples=3), evaluation=EvaluationConfig(every=20),
    network=NetworkConfig(action_embedding=4, observation_embedding=4, gru_width=8, critic_hidden=(16,),
                          actor_hidden=(16,), auxiliary_hidden=(8,)))


class Camera(Environment):
    """Frames of a robot's size, with a blank channel; nothing happens."""

    name, horizon, action_spec = "camera", 6, ContinuousActions(3)
    observation_spec, state_spec = ArraySpec((84, 84, 2), blank=1), ArraySpec((84, 84, 2))

    def reset(self, key):
        raise NotImplementedError

    def step(self, key, env_state, action):
        raise NotImplementedError


ENVIRONMENTS: dict[str, Callable[[], Environment]] = {
    "heaven_hell": lambda: registry.make("heaven_hell"), "sphinx": lambda: registry.make("sphinx"),
    "compass": Compass, "camera": Camera}


def made(domain: str, agent: str, memory: str) -> tuple[Agent, Params]:
    """A small agent with random weights; to draw them here saves compiling its own initialisation."""
    built = make_agent(ENVIRONMENTS[domain](), dataclasses.replace(CONFIG, agent=agent, memory=memory))
    rng = np.random.default_rng(0)

    def draw(shape: jax.ShapeDtypeStruct) -> np.ndarray:
        return (rng.normal(size=shape.shape) / np.sqrt(max(1, np.prod(shape.shape[:-1])))).astype(shape.dtype)

    return built, jax.tree.map(draw, jax.eval_shape(built.init_network, jax.random.key(0)))


def shown(env: Environment, number: int) -> np.ndarray:
    """(number, *observation_shape) things that an agent might see."""
    rng, spec = np.random.default_rng(0), env.observation_spec
    listed = env.all_observations()
    if listed is not None:
        return listed[rng.integers(0, len(listed), number)]
    seen = rng.normal(size=(number, *spec.shape)).astype(np.float32)
    seen[..., spec.shape[-1] - spec.blank :] = 0
    return seen


@pytest.mark.parametrize(("domain", "agent", "memory"), [
    ("heaven_hell", "mi", "gpt"), ("sphinx", "mi", "gru"), ("sphinx", "base", "gpt"), ("heaven_hell", "ua", "mlp"),
    ("heaven_hell", "ba", "gru"), ("heaven_hell", "zp", "gru"), ("sphinx", "believer", "gpt"),
    ("camera", "mi", "gpt"), ("camera", "base", "gru"), ("compass", "ua", "mlp"), ("compass", "believer", "gru")])
def test_programs_do_what_agents_do(domain: str, agent: str, memory: str, tmp_path: pathlib.Path):
    """A few steps of any observations, against the agent's own `act`, with the memory on its way."""
    built, params = made(domain, agent, memory)
    step = policy_step(built, params)
    described = contract(built, step)
    steps: list[numpy_policy.Step] = []
    for kind in ("npz", "onnx"):
        (tmp_path / kind).mkdir()
        export.save(kind, step, tmp_path / kind)
        steps.append(numpy_policy.load_step(tmp_path / kind, {"format": kind}))
    policies = [Policy(described, one) for one in steps]
    act = jax.jit(built.act)
    state, previous = built.initial_memory(1), built.no_action(1)
    actions = []
    for observation in shown(built.env, min(5, built.env.horizon)):
        state, previous = act(params, state, jnp.asarray(observation)[None], previous)
        expected = np.asarray(previous)[0]
        for policy in policies:
            np.testing.assert_allclose(policy.act(observation), expected, atol=1e-5, rtol=0)
        actions.append(expected)
    assert len(numpy_policy.measure(policies[0], seconds=0.01)) > 0
    if expected.ndim:
        assert np.ptp(actions, axis=0).max() > 0.01, "actions that do not depend on what is seen test nothing"


def test_stablehlo_runs_without_the_agent(tmp_path: pathlib.Path):
    built, params = made("sphinx", "mi", "gpt")
    step = policy_step(built, params)
    export.save("stablehlo", step, tmp_path)
    exported = jax.export.deserialize(bytearray((tmp_path / FILES["stablehlo"]).read_bytes()))
    assert exported.platforms == export.PLATFORMS
    arrays = {name: np.ones(x.shape, x.dtype) for name, x in step.inputs.items()}
    found = numpy_policy.load_step(tmp_path, {"format": "stablehlo"})(arrays)
    for name, expected in jax.jit(step.function)(arrays).items():
        np.testing.assert_allclose(found[name], expected, atol=1e-6)


def test_the_contract_says_what_is_needed():
    built, params = made("heaven_hell", "mi", "gpt")
    described = contract(built, policy_step(built, params))
    assert json.loads(json.dumps(described))["observation"]["shape"] == [3]
    assert (described["observation"]["low"], described["observation"]["high"]) == (-1.0, 1.0)
    assert described["action"]["names"] == ("right", "up", "left", "down")
    assert described["previous_action"]["at_start"] == -1
    assert [leaf["name"] for leaf in described["memory"]] == [
        "memory.position", "memory.recurrent.keys", "memory.recurrent.values"]
    assert all(leaf["next"] == NEXT + leaf["name"] for leaf in described["memory"])
    robot = registry.make("block_pulling")
    assert observation_range(robot) == (-0.021, 0.331)
    assert robot.interface.rate == pytest.approx(5)


def test_an_agent_that_sees_the_state_is_refused():
    env = make_learner(registry.make("heaven_hell"), dataclasses.replace(CONFIG, agent="mdp")).env
    built = make_agent(env, dataclasses.replace(CONFIG, agent="mdp"))
    with pytest.raises(RunError, match="'mdp' acts on the simulator's state"):
        policy_step(built, {})


def test_what_is_known_is_computed_once():
    weights = jnp.arange(6.0).reshape(2, 3)

    def function(arrays: dict[str, jax.Array]) -> dict[str, jax.Array]:
        noise = jax.random.normal(jax.random.split(jax.random.key(0), 3)[1], (2,))
        unused = jnp.sin(noise)
        del unused
        return {"y": arrays["x"] @ (2 * weights.T + noise[None])}

    program = trace.trace(function, {"x": jax.ShapeDtypeStruct((1, 3), jnp.float32)})
    assert [instruction.operation for instruction in program.code] == ["matmul"]
    x = np.ones((1, 3), np.float32)
    np.testing.assert_allclose(program({"x": x})["y"], function({"x": jnp.asarray(x)})["y"], rtol=1e-6)


def test_what_a_program_cannot_hold_is_named():
    short = {"x": jax.ShapeDtypeStruct((3,), jnp.bfloat16)}
    with pytest.raises(trace.NotTraceable, match="bfloat16"):
        trace.trace(lambda arrays: {"y": arrays["x"] + arrays["x"]}, short)
    whole = {"x": jax.ShapeDtypeStruct((3,), jnp.int32)}
    with pytest.raises(trace.NotTraceable, match="a division of whole numbers"):
        trace.trace(lambda arrays: {"y": jax.lax.div(arrays["x"], arrays["x"])}, whole)
    with pytest.raises(trace.NotTraceable, match="'sort'"):
        trace.trace(lambda arrays: {"y": jnp.sort(arrays["x"])}, {"x": jax.ShapeDtypeStruct((3,), jnp.float32)})


def policy_of(**observation: object) -> Policy:
    """A policy that answers with the sum of what it is shown, and remembers it."""
    spec = {"shape": [2], "dtype": "float32", "low": 0.0, "high": 1.0} | observation
    described = {"horizon": 3, "observation": spec, "memory": [{"name": "memory.sum", "shape": [], "dtype": "float32"}],
                 "action": {"shape": [1], "dtype": "float32", "low": -1.0, "high": 1.0},
                 "previous_action": {"shape": [1], "dtype": "float32", "at_start": 0}}

    def step(arrays: numpy_policy.Arrays) -> numpy_policy.Arrays:
        total = arrays["memory.sum"] + arrays["observation"].sum(dtype=np.float32)
        return {"action": (total + arrays["previous_action"]).astype(np.float32), "next_memory.sum": total}

    return Policy(described, step)


@pytest.mark.parametrize(("observation", "reason"), [
    ([0.5], "shape"), ([[0.5, 0.5]], "shape"), ([0.5, np.nan], "not finite"), ([np.inf, 0.5], "not finite"),
    ([0.5, 1.1], "accepted: 0 to 1"), (["a", "b"], "not an array of numbers"), ([True, False], "not an array"),
    ([[1], 2], "not an array"), (None, "not an array"), ([10**400, 0], "not an array")])
def test_a_policy_refuses_and_remembers_nothing_of_it(observation: object, reason: str):
    policy, untouched = policy_of(), policy_of()
    policy.act([0.25, 0.25])
    untouched.act([0.25, 0.25])
    with pytest.raises(Refused, match=reason):
        policy.act(observation)
    assert policy.steps == 1
    np.testing.assert_array_equal(policy.act([0.5, 0.5]), untouched.act([0.5, 0.5]))


def test_a_policy_that_would_remember_no_number_refuses():
    described = dict(policy_of().contract, action={"shape": [], "dtype": "int32", "low": 0, "high": 1})

    def step(arrays: numpy_policy.Arrays) -> numpy_policy.Arrays:
        total = arrays["memory.sum"] + arrays["observation"][0] / arrays["observation"][1]
        return {"action": np.asarray(np.argmax([total, 0]), np.int32), "next_memory.sum": total}

    policy = Policy(described, step)
    policy.act([0.5, 0.5])
    with np.errstate(divide="ignore"), pytest.raises(Refused, match="not finite, or would remember one"):
        policy.act([0.5, 0.0])
    assert policy.steps == 1
    assert policy.act([0.5, 0.5]) == 0


@pytest.mark.parametrize(("dtype", "carried", "bounds"), [
    (bool, "uint8", (0, 1)), (np.int16, "int32", (-32768, 32767)), (np.float16, "float32", (None, None))])
@pytest.mark.parametrize("kind", ["npz", "onnx", "stablehlo"])
def test_observations_of_any_dtype(dtype: type, carried: str, bounds: tuple, kind: str, tmp_path: pathlib.Path):
    class Typed(Compass):
        observation_spec = dataclasses.replace(Compass.observation_spec, dtype=dtype)

        def show(self, env_state: CompassState) -> TimeStep:
            shown = super().show(env_state)
            return dataclasses.replace(shown, observation=jnp.round(shown.observation).astype(dtype))

    env = Typed()
    agent = make_agent(env, dataclasses.replace(CONFIG, agent="base"))
    policy, found = export.write(
        kind, agent, agent.init_network(jax.random.key(1)), tmp_path / "out", {}, jax.random.key(0), 2)
    spec = policy.contract["observation"]
    assert (spec["dtype"], (spec["low"], spec["high"])) == (carried, bounds)
    assert found.largest_difference <= parity.TOLERANCE


def test_whole_numbers_and_blank_channels():
    whole = policy_of(dtype="uint8", high=None, low=None)
    with pytest.raises(Refused, match="fraction"):
        whole.act([0.5, 1])
    with pytest.raises(Refused, match="holds 256, accepted: 0 to 255"):
        whole.act([256, 1])
    with pytest.raises(Refused, match="last 1 of its channels"):
        policy_of(blank_channels=1).act([0.0, 1.0])


def test_episodes_end_and_start():
    policy = policy_of()
    with pytest.raises(Refused, match="first step"):
        policy.act([0, 0], previous_action=[0.0])
    first = [float(policy.act([0.25, 0])[0]) for _ in range(3)]
    assert first == [0.25, 0.75, 1.5], "the sum so far, and the action before"
    with pytest.raises(Refused, match="it has 3 steps"):
        policy.act([0, 0])
    policy.reset()
    assert [float(policy.act([0.25, 0])[0]) for _ in range(2)] == first[:2]
    assert policy.act([0.25, 0], previous_action=[-1.0])[0] == -0.25, "what was really done takes the answer's place"
    assert policy.another().steps == 0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> pathlib.Path:
    """A run of seeds 0 and 3 that was stopped before its first update."""
    config = dataclasses.replace(CONFIG, agent="base", memory="gru", steps=1000, dqn=DQNConfig(
        batch_episodes=4, warmup_episodes=4, replay_steps=400))
    learner = make_learner(registry.make("heaven_hell"), config)
    path = tmp_path_factory.mktemp("runs") / "run"
    folder = RunFolder.create(path, Training(config, (0, 3)).as_dict())
    init = jax.jit(learner.init)
    for seed in (0, 3):
        checkpoints = Checkpoints(folder, seed)
        checkpoints.save(200, init(training_key(seed), None))
        checkpoints.close()
    return path


@pytest.fixture(scope="module")
def exported(run: pathlib.Path) -> pathlib.Path:
    """What the command writes for its first seed."""
    assert export.main([str(run), "--to", "npz", "--episodes", "2"]) == 0
    return run / "seed_0" / "policy_npz"


def test_the_command_writes_a_policy_and_says_so(
    exported: pathlib.Path, run: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch
):
    assert {path.name for path in exported.iterdir()} == {"policy.json", "policy.npz", "numpy_policy.py", "serve.py"}
    stored = json.loads((exported / "policy.json").read_text())
    assert stored["run"]["seed"] == 0
    assert stored["run"]["step"] == 200
    assert stored["run"]["config"]["memory"] == "gru"
    assert "commit" in stored["run"]["versions"]
    assert stored["parity"]["episodes"] == 2
    assert stored["parity"]["largest_difference"] <= parity.TOLERANCE
    out = tmp_path / "onnx"
    for _ in range(2):  # the second replaces the first
        assert export.main([str(run), "--to", "onnx", "--seed", "3", "--out", str(out), "--episodes", "1"]) == 0
        assert "against the trained agent: 1 episodes" in capsys.readouterr().out
    assert Policy.load(out).contract["run"]["seed"] == 3
    (out / "my_robot.py").write_text("")
    assert export.main([str(run), "--to", "npz", "--out", str(out), "--episodes", "1"]) == 0
    assert {path.name for path in out.iterdir()} == {
        "policy.json", "policy.npz", "numpy_policy.py", "serve.py", "my_robot.py"}
    monkeypatch.chdir(out)
    assert export.main([str(run), "--to", "npz", "--out", ".", "--episodes", "1"]) == 0
    assert Policy.load(out).contract["parity"]["episodes"] == 1


def test_a_policy_needs_numpy_and_nothing_else(exported: pathlib.Path, tmp_path: pathlib.Path):
    """In a process that can import the standard library, NumPy and the folder."""
    packages = tmp_path / "packages"
    packages.mkdir()
    site = pathlib.Path(np.__file__).parents[1]
    for name in ("numpy", "numpy.libs"):
        if (site / name).exists():
            (packages / name).symlink_to(site / name)
    script = (f"import sys; sys.path[:0] = [{str(packages)!r}, {str(exported)!r}]; import runpy; "
              f"sys.argv = ['serve.py']; runpy.run_path({str(exported / 'serve.py')!r}, run_name='__main__')")
    asked = b'{"observation": [0.5, 0.75, 0.0]}\n{"observation": [0.5]}\n'
    said = subprocess.run([sys.executable, "-I", "-S", "-c", script], input=asked, capture_output=True, check=False)
    first, second = map(json.loads, said.stdout.splitlines())
    policy = Policy.load(exported)
    assert first == {"action": policy.act(np.array([0.5, 0.75, 0.0], np.float32)), "step": 1}
    assert "error" in second
    assert said.returncode == 0


failure = functools.partial(failure_of, export.main)


def test_what_cannot_be_exported_is_named(
    run: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    assert "no such run folder" in failure(capsys, str(tmp_path / "nothing"), "--to", "npz")
    assert "has no seed 7 (it has 0, 3)" in failure(capsys, str(run), "--to", "npz", "--seed", "7")
    assert "--episodes: got 0" in failure(capsys, str(run), "--to", "npz", "--episodes", "0")
    (tmp_path / "mine").write_text("something")
    assert "holds something else" in failure(capsys, str(run), "--to", "npz", "--out", str(tmp_path))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    for kind in ("onnx", "stablehlo"):
        assert "pip install -e '.[deploy]'" in failure(capsys, str(run), "--to", kind)


def test_a_policy_that_acts_otherwise_is_not_left(
    run: pathlib.Path, tmp_path: pathlib.Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    save = Program.save

    def spoilt(program: Program, path: pathlib.Path) -> None:
        negated = {name: -value if value.dtype == np.float32 else value for name, value in program.constants.items()}
        save(Program(program.inputs, program.outputs, program.code, negated), path)

    monkeypatch.setattr(Program, "save", spoilt)
    said = failure(capsys, str(run), "--to", "npz", "--out", str(tmp_path / "out"))
    assert "parity: episode 1, step" in said
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("name", "content"), [
    ("policy.npz", b"PK\x03\x04 nonsense"), ("policy.json", b"{"), ("policy.json", b'{"mijax_policy": 99}'),
    ("policy.json", b'{"mijax_policy": 1, "format": "npz", "horizon": 50}')])
def test_a_damaged_export_is_named(exported: pathlib.Path, tmp_path: pathlib.Path, name: str, content: bytes):
    for copied in ("policy.json", "policy.npz"):
        shutil.copy(exported / copied, tmp_path)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(PolicyError, match=name):
        Policy.load(tmp_path)
    with pytest.raises(PolicyError, match="not a policy's program"):
        Program.load(pathlib.Path(__file__))


@pytest.mark.slow
@pytest.mark.parametrize(("domain", "agent"), [
    ("heaven_hell", "mi"), ("sphinx", "mi"), ("carflag_2d", "base"), ("block_pulling", "mi"),
    ("drawer_opening", "base")])
def test_a_hundred_episodes_in_every_format(domain: str, agent: str, tmp_path: pathlib.Path):
    """Networks of the presets' sizes, untrained; the acceptance test of an export."""
    import configs

    built = make_agent(registry.make(domain), dataclasses.replace(configs.preset(domain), agent=agent))
    params = jax.jit(built.init_network)(jax.random.key(0))
    step = policy_step(built, params)
    policies = []
    for kind in FILES:
        (tmp_path / kind).mkdir()
        export.save(kind, step, tmp_path / kind)
        described = contract(built, step)
        policies.append(Policy(described, numpy_policy.load_step(tmp_path / kind, {"format": kind})))
    episodes = 0
    for episode in parity.play(built, params, jax.random.key(1), 100):
        episodes += 1
        for policy in policies:
            parity.compare(policy, [episode])  # raises where they differ
    assert episodes == 100


def test_a_declared_range_comes_first():
    class Narrow(Compass):
        interface = Interface(observation_range=(-2.0, 2.0))

    assert observation_range(Narrow()) == (-2.0, 2.0)
    assert observation_range(Compass()) == (None, None)
    assert observation_range(registry.make("sphinx")) == (0, 1)
