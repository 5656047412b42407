"""The SAC core: its losses against loops and quadrature, what its networks see, its replay, and whether it learns."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compass import Compass, CompassState
from scipy import integrate, stats
from tokens import (
    CONTINUOUS,
    END,
    FEATURES,
    ROW,
    SPANS,
    TINY,
    AgentCase,
    Shapes,
    dependencies,
    random_like,
    representation,
)

from envs_mjx.base import Demonstrations, TimeStep
from mijax.agents.core import AgentState, adam
from mijax.agents.factory import make_agent
from mijax.agents.sac import SAC, make_sac
from mijax.agents.variants import VARIANTS, needs_representation, title_of
from mijax.config import (
    BelieverConfig,
    Config,
    ConfigError,
    EvaluationConfig,
    InformationConfig,
    NetworkConfig,
    SACConfig,
    Stage1Config,
)
from mijax.learner import Learner, LearnerState, make_learner
from mijax.losses import sac
from mijax.packing import one_per_row
from mijax.replay import Replay
from mijax.representation.model import networks_for
from mijax.types import Tokens

ACTIONS, GAMMA, TEMPERATURE = CONTINUOUS.size, 0.9, 0.3
CONFIG = Config(
    stage1=Stage1Config(features=FEATURES), network=TINY, believer=BelieverConfig(samples=5, updates=2),
    sac=SACConfig(discount=GAMMA, target_rate=0.1, batch_episodes=8, critic_norm=False), num_envs=2,
    steps_per_iteration=3, evaluation=EvaluationConfig(every=12),
    information=InformationConfig(intrinsic_weight=0.5, auxiliary_weight=0.25, intrinsic_form="explained_variance"))


class Case(AgentCase[SAC]):
    """An agent on SAC with random parameters."""

    def __init__(self, name: str, **changes: Any) -> None:
        super().__init__(make_sac, CONTINUOUS, dataclasses.replace(CONFIG, agent=name, **changes))
        self.params = self.state.params["agent"]
        self.state.params["log_temperature"] = jnp.log(jnp.float32(TEMPERATURE))
        self.says = jax.jit(self._says)

    def _says(self, params: Any, tokens: Tokens, action: jax.Array) -> tuple[Any, ...]:
        """The policy's mean and log scale (R, L, A), both critics' values (2, R, L) of (R, L, A) actions, the heads."""
        encoded = self.agent._encode(params, self.agent.look(params, tokens))
        mean, log_scale = self.agent._call("policy", params, encoded.actor)
        values = self.agent._call("values", params, encoded.critic, action.reshape(-1, ACTIONS))
        shape = tokens.segment.shape
        return mean.reshape(*shape, -1), log_scale.reshape(*shape, -1), values.reshape(2, *shape), encoded.heads


# The losses


@pytest.mark.parametrize(("mean", "log_scale"), [(0.0, 0.0), (0.7, -1.0), (-2.0, 0.5)])
def test_density_of_the_squashed_gaussian(mean: float, log_scale: float):
    """Against the change of variables by scipy, and it integrates to 1."""
    def density(action: float) -> float:
        before = np.arctanh(action)
        return float(stats.norm.pdf(before, mean, np.exp(log_scale)) / (1 - action**2))

    total, _ = integrate.quad(density, -1, 1, limit=200)
    assert total == pytest.approx(1, abs=1e-4)
    for noise in (-1.5, 0.0, 0.8):
        action, log_prob = sac.sample_tanh_gaussian(*(jnp.array([x], jnp.float32) for x in (mean, log_scale, noise)))
        assert float(action[0]) == pytest.approx(np.tanh(mean + np.exp(log_scale) * noise), rel=1e-5)
        assert float(log_prob) == pytest.approx(np.log(density(float(action[0]))), rel=1e-3, abs=1e-3)


def test_imitation_fits_the_scale_to_what_is_left():
    """Its gradient is 0 where the scale is the distance; the mean's is that of the squared distance alone."""
    shown, mask = jnp.array([[0.3], [-0.3]]), jnp.ones((2,), bool)

    def loss(action: float, log_scale: float) -> jax.Array:
        arguments = jnp.full((2, 1), action), jnp.full((2, 1), log_scale), shown, mask
        return sac.imitation_loss(arguments[0], shown, mask) + sac.scale_loss(*arguments)

    gradients = [float(jax.grad(loss, argnums=1)(0.0, jnp.log(scale))) for scale in (0.2, 0.3, 0.4)]
    np.testing.assert_allclose(gradients, [0.2**2 - 0.3**2, 0, 0.4**2 - 0.3**2], atol=1e-6)
    assert float(jax.grad(loss)(0.1, -3.0)) == pytest.approx(2 * 0.1)


def test_density_far_in_the_tails_is_finite():
    far = jnp.array([30.0, -30.0], jnp.float32)
    np.testing.assert_allclose(sac.log_slope_of_tanh(far), 2 * np.log(2) - 2 * np.abs(far), rtol=1e-6)


def test_temperature_loss_pulls_the_entropy_to_its_target():
    def gradient(entropy: float) -> float:
        log_prob, mask = jnp.full((3,), -entropy), jnp.ones((3,), bool)
        return float(jax.grad(lambda x: sac.temperature_loss(x, log_prob, -2.0, mask)[0])(jnp.float32(-1.0)))

    assert gradient(-3.0) < 0  # too little entropy: the temperature rises
    assert gradient(-1.0) > 0
    assert gradient(-2.0) == pytest.approx(0)


def draws(key: jax.Array) -> Any:
    """The standard normal noise of the actor's draws for all tokens."""
    return np.asarray(jax.random.normal(key, (2 * ROW, ACTIONS))).reshape(2, ROW, ACTIONS)


def drawn_by_hand(mean: Any, log_scale: Any, noise: Any) -> tuple[np.ndarray, np.ndarray]:
    before = np.asarray(mean) + np.exp(log_scale) * noise
    log_prob = stats.norm.logpdf(before, mean, np.exp(log_scale)) + 2 * np.log(np.cosh(before))
    return np.tanh(before).astype(np.float32), log_prob.sum(-1)


def taken_actions(case: Case) -> jax.Array:
    """(R, L, A) what was done at each token."""
    return jnp.roll(case.tokens.previous_action, -1, axis=1)


def losses_by_loops(case: Case, bonus: np.ndarray) -> dict[str, float]:
    """The critics' and the actor's loss and the entropy, transition by transition."""
    tokens, options = jax.device_get(case.tokens), case.config.sac
    _, _, key_action, key_next = jax.random.split(jax.random.key(0), 4)
    mean, log_scale, q, _ = case.says(case.params, case.tokens, taken_actions(case))
    action, log_prob = drawn_by_hand(mean, log_scale, draws(key_action))
    next_action, next_log_prob = drawn_by_hand(mean, log_scale, draws(key_next))
    q_drawn = np.asarray(case.says(case.params, case.tokens, action)[2])
    # The target critics look through the online trunk: frames are encoded once.
    mixed = case.state.target | {"trunk": case.params["trunk"]}
    q_next = np.asarray(case.says(mixed, case.tokens, next_action)[2]).min(0)
    errors, advantages, entropies = [], [], []
    for row, first, end in SPANS:
        later = 0.0
        for t in reversed(range(first + 1, end)):  # the transition that arrives at token t
            soft = q_next[row, t] - TEMPERATURE * next_log_prob[row, t]
            ended = tokens.terminated[row, t] or (tokens.truncated[row, t] and not options.bootstrap_at_time_limit)
            trace = options.trace_decay if t + 1 < end else 0.0
            future = 0.0 if ended else GAMMA * ((1 - trace) * soft + trace * later)
            later = tokens.reward[row, t] + bonus[row, t] + future
            errors.append(np.sum((later - np.asarray(q)[:, row, t - 1]) ** 2))
            advantages.append(TEMPERATURE * log_prob[row, t - 1] - q_drawn[:, row, t - 1].min())
            entropies.append(-log_prob[row, t - 1])
    means = (float(np.mean(values)) for values in (errors, advantages, entropies))
    return dict(zip(("loss/td", "loss/actor", "actor/entropy"), means, strict=True))


def check_losses(case: Case, updates: int, expected: dict[str, float], weights: dict[str, float]) -> None:
    """The parts are as expected, and the loss is their sum by `weights`, with the temperature's and those of all."""
    loss, metrics = case.losses(updates)
    for part, value in expected.items():
        assert metrics[part] == pytest.approx(value, rel=2e-3, abs=1e-5), part
    total = expected["loss/td"] + expected["loss/actor"] + np.log(TEMPERATURE) * (expected["actor/entropy"] + ACTIONS)
    assert loss == pytest.approx(total + sum(w * expected[part] for part, w in weights.items()), rel=2e-3)


IMITATING = dataclasses.replace(
    CONFIG.sac, demonstrations=1, imitation_weight=3.0, imitation_until=0.5, imitation_final=0.2)


@pytest.mark.parametrize("successes", [False, True])
def test_losses_by_hand_with_imitation(successes: bool):
    """The first and the last episode are an expert's; the mean may imitate the second one too."""
    case = Case("base", sac=dataclasses.replace(IMITATING, bootstrap_at_time_limit=False, trace_decay=0.0))
    second = case.tokens.segment == 2
    meant = jax.random.uniform(jax.random.key(7), case.tokens.previous_action.shape, minval=-1.0)
    case.tokens = dataclasses.replace(
        case.tokens, intended=meant, demonstrated=~second, succeeded=second if successes else None)
    expected, taken = losses_by_loops(case, np.zeros((2, ROW))), taken_actions(case)
    mean, log_scale, _, _ = case.says(case.params, case.tokens, taken)

    def distances(*spans: tuple[int, int, int]) -> np.ndarray:
        """Of the mean to each coordinate of the actions that were meant."""
        return np.array([np.tanh(mean[row, t]) - meant[row, t + 1] for row, first, end in spans
                         for t in range(first, end - 1)])

    moves = distances(SPANS[0], SPANS[2])
    scales = np.array([log_scale[row, t] for row, first, end in (SPANS[0], SPANS[2]) for t in range(first, end - 1)])
    variances = np.exp(2 * scales)
    expected["loss/scale"] = np.mean(np.sum(variances * (moves**2 / (2 * variances) + scales), axis=-1))
    expected["actor/distance"] = np.mean(np.sum(moves**2, axis=-1))
    near = distances(*SPANS) if successes else moves
    expected["loss/imitation"] = np.mean(np.sum(near**2, axis=-1))
    quarter = case.config.sac.updates_in(CONFIG.steps) // 4  # half of the way from 1 to 0.2
    check_losses(case, quarter, expected, {"loss/imitation": 3.0 * 0.6, "loss/scale": 0.6})


def test_losses_and_bonus_of_ours_by_hand():
    case = Case("mi", sac=dataclasses.replace(IMITATING, bootstrap_at_time_limit=True, trace_decay=0.7))
    tokens = jax.device_get(case.tokens)
    z, real = tokens.z_s, tokens.segment > 0

    def error(prediction: Any, z: np.ndarray) -> np.ndarray:
        """Of a prediction in units of z_s's standard deviation, in units of its variance."""
        return np.sum((z - np.arange(FEATURES) - np.sqrt(2) * np.asarray(prediction)) ** 2, axis=-1) / 2

    model: Any = case.agent.information_model
    believed = jax.jit(model.apply)(
        {"params": case.state.params["f"][0]}, jax.jit(case.agent.look)(case.params, case.tokens))
    f = np.asarray(believed.mean)
    bonus = np.zeros((2, ROW))
    for row, first, end in SPANS:
        for t in range(first + 1, end):
            bonus[row, t] = 0.5 * (error(f[row, t - 1], z[row, t - 1]) - error(f[row, t], z[row, t]))
    heads = case.says(case.params, case.tokens, taken_actions(case))[3]
    expected = losses_by_loops(case, bonus) | {
        "loss/f": error(f, z)[real].mean(),
        "loss/auxiliary": np.mean([error(head.z_s, z)[real].mean() for head in heads])}
    check_losses(case, 0, expected, {"loss/f": 1.0, "loss/auxiliary": 0.25 * 2})  # that of both branches


HEADS = {"value_heads_0", "value_heads_1"}


@pytest.mark.parametrize(("name", "expected"), [
    ("mi", {"loss/actor": {"actor", "policy_head"}, "loss/td": {"trunk", "critic", *HEADS}, "loss/f": {"f"},
            "loss/auxiliary": {"trunk", "actor", "critic"}}),
    ("ua", {"loss/actor": {"actor", "policy_head"}, "loss/td": {"trunk", "critic", "state_encoder", *HEADS}}),
    ("ba", {"loss/actor": {"trunk", "actor", "policy_head"}, "loss/td": {"state_encoder", *HEADS}}),
    ("believer", {"loss/actor": {"actor", "policy_head"}, "loss/td": {"trunk", "history", *HEADS},
                  "loss/belief": {"trunk", "history"}})])
def test_who_learns_from_what(name: str, expected: dict[str, set[str]]):
    """The actor's loss moves the actor alone, and the trunk where the critics do not look through it; the critics' the
    trunk too; f learns from its own loss only."""
    case = Case(name)

    @jax.jit
    def gradients(params: Any) -> dict[str, Any]:
        def part(params: Any, name: str) -> jax.Array:
            arguments = case.state.target, case.tokens, case.representation, case.state.updates, jax.random.key(0)
            return case.agent.loss(params, *arguments)[1][name]

        return {name: jax.grad(part)(params, name) for name in expected}

    def moved(tree: Any) -> set[str]:
        parts = tree["agent"] | {"f": tree.get("f", {})}
        return {name for name, part in parts.items() if any(np.any(x) for x in jax.tree.leaves(part))}

    found = {name: moved(tree) for name, tree in jax.device_get(gradients(case.state.params)).items()}
    assert found == expected


@pytest.mark.lenient
def test_every_module_of_believer_is_trained():
    case = Case("believer")
    after, _ = jax.jit(case.agent.update)(case.state, case.tokens, case.representation, jax.random.key(0))
    still = jax.tree.map(lambda x, y: bool((x == y).all()), after.params["agent"], case.state.params["agent"])
    assert not any(jax.tree.leaves(still))


# What the networks see

SEEN = {  # agent: what the actor's choice at the last token of an episode depends on, and the critics
    "mi": ("past present", "past present"), "base": ("past present", "past present"),
    "zp": ("past present", "past present"), "ba": ("past present", "state"),
    "ua": ("past present", "past present state"), "believer": ("past present", "past present"),
    "mdp": ("present state", "present state"),
}


@pytest.mark.parametrize(("name", "trunk"), [*((name, "shared") for name in VARIANTS), ("mi", "own"), ("ua", "own")])
def test_what_each_network_sees(name: str, trunk: Any):
    case = Case(name, sac=dataclasses.replace(CONFIG.sac, trunk=trunk))

    def at_the_end(tokens: Tokens) -> dict[str, Any]:
        mean, _, values, _ = case.says(case.params, tokens, jnp.zeros((2, ROW, ACTIONS)))
        return {"actor": mean[END], "critic": values[:, *END]}

    found = dependencies(at_the_end, case.tokens)
    assert (found["actor"], found["critic"]) == SEEN[name]


@pytest.mark.parametrize(("name", "memory"), [("base", "gpt"), ("mi", "gru"), ("believer", "gpt")])
def test_step_by_step_equals_the_full_pass(name: str, memory: Any):
    case = Case(name, memory=memory)
    tokens, agent = case.tokens, case.params
    mean, _, _, _ = case.says(agent, tokens, tokens.previous_action)
    frames, act = np.asarray(tokens.frames).reshape(2, ROW, 2), jax.jit(case.agent.act)
    for row, first, end in SPANS:
        state = case.agent.initial_memory(1)
        for t in range(first, end):
            state, action = act(agent, state, jnp.asarray(frames[row, t][None]), tokens.previous_action[row, t][None])
            np.testing.assert_allclose(action[0], np.tanh(mean[row, t]), atol=2e-5)


def test_the_first_environments_may_be_greedy():
    """They act by the mean, the others around it; all act at random in the warm-up."""
    case = Case("base", num_envs=3, sac=dataclasses.replace(CONFIG.sac, greedy_environments=2),
                evaluation=EvaluationConfig(every=9))
    frames, none = jnp.ones((3, 2)), case.agent.no_action(3)
    small = jax.tree.map(lambda x: x / 10, case.params)  # a mean that tanh does not round to 1
    arguments = small, case.agent.initial_memory(3), frames, none
    greedy, explore = jax.jit(case.agent.act)(*arguments)[1], jax.jit(case.agent.explore)
    _, action = explore(*arguments, jnp.float32(0), jax.random.key(0))
    np.testing.assert_allclose(action[:2], greedy[:2], atol=1e-6)
    assert np.max(np.abs(action[2] - greedy[2])) > 1e-3
    _, action = explore(*arguments, jnp.float32(1), jax.random.key(0))
    assert len(np.unique(action)) == action.size


@pytest.mark.parametrize("name", ["base", "ua"])
def test_the_value_of_a_beginning(name: str):
    """The smaller critic's, of the mean action at the first token; unknown where the critics want the state."""
    case = Case(name)
    agent, tokens = case.params, case.tokens
    first = jnp.asarray(tokens.frames).reshape(2, ROW, 2)[:, 0]
    value = jax.jit(case.agent.value)(agent, case.agent.initial_memory(2), first, tokens.previous_action[:, 0])
    if name == "ua":
        assert np.isnan(value).all()
    else:
        mean, _, _, _ = case.says(agent, tokens, tokens.previous_action)
        q = case.says(agent, tokens, jnp.tanh(mean))[2]
        np.testing.assert_allclose(value, np.asarray(q)[:, :, 0].min(0), atol=2e-5)


@pytest.mark.lenient
def test_the_step_size_falls_over_all_updates():
    options = SACConfig(learning_rate=0.1, final_learning_rate=0.2, updates_per_step=0.5)
    optimizer = adam(options, options.updates_in(20))  # 10 updates
    params, moves = jnp.zeros(()), []
    state = optimizer.init(params)
    for _ in range(12):
        move, state = optimizer.update(jnp.ones(()), state, params)
        moves.append(-np.asarray(move))  # Adam moves by its step size where the gradient is always the same
    np.testing.assert_allclose(moves, [*np.linspace(0.1, 0.02, 11), 0.02], rtol=1e-4)


def test_psi_starts_the_trunk_and_every_memoryless_branch():
    env = Shapes(CONTINUOUS)
    rep = representation(env)
    body = {name: part for name, part in rep.psi.items() if name != "output"}
    for name, trunk in (("mi", "shared"), ("mi", "own"), ("base", "psi"), ("mi", "z_o"), ("base", "z_o")):
        config = dataclasses.replace(CONFIG, agent=name, sac=dataclasses.replace(CONFIG.sac, trunk=trunk))
        agent = jax.jit(make_agent(env, config).init)(jax.random.key(3), rep).params["agent"]
        for branch in ("actor", "critic") if name == "mi" else ():
            identity = {"kernel": np.eye(FEATURES), "bias": np.zeros(FEATURES)}
            expected = {"own": rep.psi, "shared": rep.psi["output"], "z_o": identity}[trunk]
            jax.tree.map(np.testing.assert_array_equal, agent[branch]["bottom"], expected)
        assert ("trunk" in agent) == (trunk != "own")
        if trunk != "own":
            jax.tree.map(np.testing.assert_array_equal, agent["trunk"], rep.psi if trunk == "z_o" else body)


def test_titles_follow_the_algorithm():
    titles = [title_of(dataclasses.replace(CONFIG, agent=name), continuous=True) for name in VARIANTS]
    assert titles == ["Ours", "TSAC", "ZP-RSAC", "BA-TSAC", "UA-TSAC", "B-SAC", "MDP"]


@pytest.mark.parametrize(("changes", "message"), [
    ({"demonstrations": 3}, "--sac.demonstrations: got 3, accepted: 0, as shapes has no expert"),
    ({"rotated_copies": 4}, "--sac.rotated-copies: got 4, accepted: 0, as shapes cannot show a moment again"),
    ({"updates_per_step": 0.05}, "--sac.updates-per-step: got 0.05"),
    ({"imitation_weight": 1.0}, "--sac.imitation-weight: got 1.0, accepted: 0, unless there are --sac.demonstrations"),
    ({"pretrain_updates": 9}, "--sac.pretrain-updates: got 9, accepted: 0, unless there are --sac.demonstrations"),
    ({"imitate_successes": True},
     "--sac.imitate-successes: got True, accepted: False, unless there is an --sac.imitation-weight"),
    ({"greedy_environments": 2}, "--sac.greedy-environments: got 2, accepted: a number below num-envs = 2"),
    ({"batch_episodes": 7}, "--sac.batch-episodes: got 7, accepted: an even number"),
    ({"initial_temperature": 0.0}, "--sac.initial-temperature: got 0.0, accepted: a number > 0"),
])
def test_bad_options_are_refused_in_one_line(changes: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        make_agent(Shapes(CONTINUOUS), dataclasses.replace(CONFIG, sac=dataclasses.replace(CONFIG.sac, **changes)))


# In the loop


class Run:
    """A learner on `Compass` with its functions compiled."""

    def __init__(self, config: Config, env: Compass | None = None) -> None:
        self.learner = make_learner(env or Compass(), config, pack=False)
        self.representation = representation(Compass()) if needs_representation(config) else None
        self.init, self.chunk = jax.jit(self.learner.init), jax.jit(self.learner.run_chunk)
        self.evaluate = jax.jit(self.learner.evaluate, static_argnums=2)

    def start(self, seed: int = 0) -> LearnerState:
        return self.init(jax.random.key(seed), self.representation)


LOOP = dataclasses.replace(
    CONFIG, sac=dataclasses.replace(CONFIG.sac, demonstrations=5, rotated_copies=3), memory="gru")


@pytest.fixture(scope="module")
def ours() -> tuple[Run, LearnerState]:
    """`mi` with demonstrations and copies, before learning."""
    run = Run(LOOP)
    return run, run.start()


@pytest.mark.lenient
def test_demonstrations_are_in_the_replay_from_the_start(ours: tuple[Run, LearnerState]):
    state = jax.device_get(ours[1])
    replay = state.replay
    assert int(replay.count) >= 5
    for slot in replay.finished[:5]:
        assert replay.length[slot] == Compass.choice + 2
        data = jax.tree.map(lambda x, slot=slot: x[slot], replay.data)
        moments, actions = data.observation, data.previous_action
        assert moments.rewarded.tolist() == [False] * 3 + [True, False]
        np.testing.assert_allclose(actions[0], 0)
        np.testing.assert_allclose(actions[1:4], 0.8 * np.asarray(moments.cue)[:3], rtol=1e-6)
        assert data.reward[3] == 1
        assert bool(data.terminated[3])


@pytest.mark.lenient
def test_successes_are_known(ours: tuple[Run, LearnerState]):
    """Episodes that return what demonstrations do, demonstrations among them."""
    state = ours[1]
    config = dataclasses.replace(LOOP, sac=dataclasses.replace(LOOP.sac, imitation_weight=1.0, imitate_successes=True))
    learner, replay = make_learner(Compass(), config, pack=False), state.replay
    number = int(replay.count)
    slots = replay.finished[jnp.arange(8) % number]
    pointed = np.asarray(replay.data.reward[slots, Compass.choice + 1]) > 0
    assert pointed.any()
    assert not pointed.all()
    tokens = jax.jit(lambda slots: learner._read(replay, slots, one_per_row(8), 8, jax.random.key(0)))(slots)
    real = np.asarray(tokens.segment) > 0
    np.testing.assert_array_equal(np.asarray(tokens.succeeded)[real], np.repeat(pointed[:, None], 5, axis=1)[real])


class Clumsy(Compass):
    """Whose expert solves only the last few of its episodes, every other one in a step less."""

    def __init__(self, solved: int):
        self.solved = solved

    def demonstrations(self, key: jax.Array, number: int) -> Demonstrations:
        shown, numbers = super().demonstrations(key, number), jnp.arange(number, dtype=jnp.int32)
        return dataclasses.replace(shown, length=shown.length - numbers % 2, success=numbers >= number - self.solved)


@pytest.mark.parametrize(("solved", "lengths"), [(2, [3, 2, 3, 2]), (0, [-1] * 4)])
def test_an_expert_that_fails(solved: int, lengths: list[int]):
    """Its successes are kept, again and again; without any there are none."""
    config = dataclasses.replace(LOOP, agent="base", sac=dataclasses.replace(
        LOOP.sac, demonstrations=4, rotated_copies=0, pretrain_updates=0, imitation_weight=0.0, trunk="own"))
    run = Run(config, Clumsy(solved))
    state = run.start()
    steps = state.replay.length[config.num_envs :][:4] - 1
    assert steps.tolist() == lengths
    assert run.learner.has_demonstrations(state) is (solved > 0)


@pytest.mark.lenient
def test_a_sampled_copy_is_turned_as_a_whole(ours: tuple[Run, LearnerState]):
    """Frames, actions, states and z_s of an episode turn by one angle; copy 0 not at all; angles differ otherwise."""
    run, state = ours
    learner, replay, slots = run.learner, state.replay, state.replay.finished[jnp.zeros((8,), jnp.int32)]
    read = jax.jit(lambda key: learner._read(replay, slots, one_per_row(8), 8, key))
    tokens = jax.device_get(read(jax.random.key(4)))
    cue = np.asarray(replay.data.observation.cue)[int(slots[0]), 0]
    length, angles = Compass.choice + 2, []
    phi = networks_for(Compass(), FEATURES).phi
    for row in range(8):
        seen = np.asarray(tokens.frames).reshape(8, -1, 4)[row, 0, :2]
        angle = np.arctan2(seen[1], seen[0]) - np.arctan2(cue[1], cue[0])
        angles.append(np.round(angle % (2 * np.pi), 3))
        np.testing.assert_allclose(tokens.previous_action[row, 1:length], np.tile(0.8 * seen, (3, 1)), atol=1e-5)
        turned = jnp.array([[*seen, t] for t in range(length)], jnp.float32)
        labels: Any = phi.apply({"params": state.representation.phi}, turned)  # pyright: ignore[reportOptionalMemberAccess]
        np.testing.assert_allclose(tokens.z_s[row, :length], labels, atol=1e-4)
    assert 0.0 in [x % 6.283 for x in angles]
    assert 2 < len(set(angles)) <= 4


class Shaky(Compass):
    """Whose expert means half of what it does."""

    def demonstrations(self, key: jax.Array, number: int) -> Demonstrations:
        shown = super().demonstrations(key, number)
        return dataclasses.replace(shown, intended=shown.action / 2)


@pytest.mark.lenient
@pytest.mark.parametrize("trunk", ["shared", "psi"])
def test_what_an_expert_meant_is_turned_too(trunk: str):
    """Demonstrations come with what was meant, in every copy; the agent's own episodes with what was done."""
    config = dataclasses.replace(LOOP, sac=dataclasses.replace(LOOP.sac, imitation_weight=1.0, trunk=trunk))
    run = Run(config, Shaky())
    state = run.start()
    shown, own = (jnp.broadcast_to(state.replay.finished[place], (4,)) for place in (0, LOOP.sac.demonstrations))
    slots = jnp.concatenate([shown, own])
    tokens = jax.jit(lambda: run.learner._read(state.replay, slots, one_per_row(8), 8, jax.random.key(4)))()
    half = np.where(np.asarray(tokens.demonstrated), 0.5, 1.0)[..., None]
    assert 0 < np.count_nonzero(half == 0.5) < half.size
    np.testing.assert_allclose(np.asarray(tokens.intended), half * np.asarray(tokens.previous_action), atol=1e-6)
    assert len(np.unique(np.round(np.asarray(tokens.previous_action)[:4, 1, 0], 3))) > 1


@pytest.mark.lenient
@pytest.mark.parametrize(("trunk", "method"), [("psi", "body"), ("z_o", "__call__")])
def test_a_frozen_trunk_looks_once(ours: tuple[Run, LearnerState], trunk: Any, method: str):
    """The replay holds what psi or its body says of each copy; updates get that, and leave the trunk alone."""
    run, state = ours
    frozen = Run(dataclasses.replace(LOOP, sac=dataclasses.replace(LOOP.sac, trunk=trunk)))
    start = frozen.start()
    slots = state.replay.finished[jnp.zeros((8,), jnp.int32)]

    def read(run: Run, state: LearnerState) -> Tokens:
        return jax.jit(lambda key: run.learner._read(state.replay, slots, one_per_row(8), 8, key))(jax.random.key(4))

    shown, seen = read(run, state), read(frozen, start)
    real = np.asarray(shown.segment).reshape(-1) > 0
    assert run.representation is not None
    psi = networks_for(Compass(), FEATURES).psi
    wanted = psi.apply({"params": run.representation.psi}, jnp.asarray(shown.frames), method=method)
    np.testing.assert_allclose(np.asarray(seen.frames)[real], np.asarray(wanted)[real], rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(seen.previous_action, shown.previous_action, atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(seen.z_s).reshape(len(real), -1)[real], np.asarray(shown.z_s).reshape(len(real), -1)[real],
        atol=1e-5)
    update = jax.jit(lambda state: frozen.learner.update(state.agent, state.replay, state.representation, state.key)[0])
    before, now = start.agent.params["agent"], update(start).params["agent"]
    jax.tree.map(np.testing.assert_array_equal, before["trunk"], now["trunk"])
    assert (np.asarray(before["actor"]["bottom"]["kernel"]) != np.asarray(now["actor"]["bottom"]["kernel"])).any()


@pytest.mark.lenient
@pytest.mark.parametrize(("agent", "trunk"), [
    ("ua", "psi"), *(pytest.param(*pair, marks=pytest.mark.slow) for pair in (
        ("ua", "shared"), ("believer", "shared"), ("believer", "psi"), ("base", "psi"), ("mdp", "shared")))])
def test_every_agent_runs_in_the_loop(agent: str, trunk: Any):
    sac = dataclasses.replace(
        LOOP.sac, trunk=trunk, pretrain_updates=5, imitation_weight=1.0, imitate_successes=True)
    run = Run(dataclasses.replace(LOOP, agent=agent, memory="auto", sac=sac,
                                  stage1=Stage1Config(features=FEATURES, episodes=4)))
    start = run.start()
    assert int(start.iteration) == -1
    ready, _ = run.chunk(start, 1, acts=False)
    assert int(ready.agent.updates) == 6  # those of whole iterations
    jax.tree.map(np.testing.assert_array_equal, ready.replay, start.replay)
    state, metrics = run.chunk(ready, 2, acts=True)
    assert int(state.iteration) == 2
    assert int(state.agent.updates) == 6 + 12
    assert int(run.learner.environment_steps(state)) == run.learner.warmup_steps + 12
    assert all(np.isfinite(x) for name, x in jax.device_get(metrics).items() if name.startswith(("loss/", "actor/")))
    results = jax.device_get(run.evaluate(state, jax.random.key(0), 3))
    assert (results["length"] == Compass.choice + 1).all()


@pytest.mark.lenient
@pytest.mark.parametrize("data", ["demonstrations", "random"])
def test_believers_history_model_is_fitted_to_stage_1s_kind_of_episodes(data: Any, monkeypatch: pytest.MonkeyPatch):
    fitted = []

    def update(_: Learner, agent: AgentState, replay: Replay, *__: Any, **___: Any) -> tuple[AgentState, dict]:
        fitted.append(replay)
        return agent, {}

    run = Run(dataclasses.replace(
        LOOP, agent="believer", memory="auto", stage1=Stage1Config(features=FEATURES, episodes=4, data=data)))
    state = run.start()
    monkeypatch.setattr(Learner, "update", update)
    run.learner._believe(state, jax.random.key(0))
    shown = data == "demonstrations"
    assert (fitted[0] is state.replay) is shown
    assert int(fitted[0].count) >= 4


class Spelled(Compass):
    """The reward is the action, in other units at every step: the return spells what was done."""

    def step(self, key: jax.Array, env_state: CompassState, action: jax.Array) -> tuple[CompassState, TimeStep]:
        later, timestep = super().step(key, env_state, action)
        reward = jnp.dot(action, jnp.array([1.0, 3.0])) * jnp.exp(env_state.time.astype(jnp.float32))
        return later, dataclasses.replace(timestep, reward=reward)


class Garbage(Spelled):
    """The same task, whose states are noise."""

    def show(self, env_state: CompassState) -> TimeStep:
        timestep = super().show(env_state)
        return dataclasses.replace(timestep, state=jnp.sin(97.0 * timestep.state))


@pytest.mark.lenient
def test_acting_sees_no_state():
    """Even that of `ua`, whose critics do: greedy or exploring, its actions are the same whatever the states say."""
    config = dataclasses.replace(CONFIG, agent="ua", memory="gru")
    runs = [Run(config, env) for env in (Spelled(), Garbage())]
    state = runs[0].start()
    params = random_like(state.agent.target, 0.2)
    agent = dataclasses.replace(state.agent, params=state.agent.params | {"agent": params}, target=params)
    state = dataclasses.replace(state, agent=agent)
    greedy, other = (run.evaluate(state, jax.random.key(3), 16)["return"] for run in runs)
    np.testing.assert_allclose(other, greedy, rtol=1e-5)
    assert np.std(greedy) > 0.1  # it does act on what it sees
    exploring, other = (jax.jit(run.learner.collect_chunk)(state)[0] for run in runs)
    assert int(exploring.episodes) == int(other.episodes) > 0
    np.testing.assert_allclose(other.returns, exploring.returns, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.lenient
def test_a_seed_is_the_same_alone_and_beside_others_and_goes_on_where_it_stopped(ours: tuple[Run, LearnerState]):
    run, start = ours
    once, _ = run.chunk(start, 2)
    twice, _ = run.chunk(run.chunk(start, 1)[0], 1)

    def numbers(state: LearnerState) -> list[Any]:
        return jax.tree.leaves((state.agent, state.replay))

    for x, y in zip(numbers(once), numbers(twice), strict=True):
        np.testing.assert_array_equal(x, y)
    init, keys = run.learner.agent.init, jax.random.key(9)
    both = jax.jit(jax.vmap(lambda seed: init(jax.random.key(seed), run.representation)))(jnp.arange(2))
    update = lambda agent: run.learner.update(agent, start.replay, run.representation, keys)[0].params  # noqa: E731
    together = jax.jit(jax.vmap(update))(both)
    alone = jax.jit(update)(jax.tree.map(lambda x: x[1], both))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x[1], y, atol=2e-5), together, alone)


LEARNING = dataclasses.replace(
    CONFIG, num_envs=8, steps_per_iteration=4, steps=6400,
    network=NetworkConfig(action_embedding=8, observation_embedding=8, gru_width=16, critic_hidden=(32,),
                          actor_hidden=(32,), auxiliary_hidden=(32,), dropout=0.0),
    sac=SACConfig(batch_episodes=16, updates_per_step=0.25, learning_rate=3e-3, target_rate=0.02, replay_steps=20_000,
                  warmup_episodes=10, demonstrations=40, rotated_copies=4),
    information=InformationConfig(intrinsic_weight=0.1), evaluation=EvaluationConfig(every=6400))


@pytest.mark.lenient
@pytest.mark.parametrize(("agent", "memory"), [
    ("base", "gru"), pytest.param("base", "gpt", marks=pytest.mark.slow),
    pytest.param("mi", "gpt", marks=pytest.mark.slow)])
def test_a_memory_task_is_solved(agent: str, memory: Any):
    run = Run(dataclasses.replace(LEARNING, agent=agent, memory=memory))
    state, _ = run.chunk(run.start())
    results = jax.device_get(run.evaluate(state, jax.random.key(1), 200))
    assert results["success"].mean() >= 0.9
