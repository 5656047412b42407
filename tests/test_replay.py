"""The replay of whole episodes, and packing them into rows, against plain Python."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mijax.packing import first_fit, fit_folds, gather_rows, one_per_row, row_choices, stack_folds
from mijax.replay import Replay, StepRecord, finish, init_replay, sample_episodes, write

HORIZON, NUM_ENVS, FEATURES = 4, 3, 2
quick = settings(max_examples=25, deadline=None, derandomize=True)


def record_of(episode: np.ndarray, position: np.ndarray, length: np.ndarray) -> StepRecord:
    """A step whose every field tells which episode and which step it is."""
    mark = (10 * episode + position).astype(np.float32)
    fields: dict[str, Any] = {
        "observation": (mark[:, None] % 256).astype(np.uint8),
        "previous_action": np.where(position == 0, -1, mark % 7).astype(np.int8),
        "reward": mark + np.float32(0.25),
        "terminated": (position == length) & (episode % 2 == 0),
        "truncated": (position == length) & (episode % 2 == 1),
        "z_s": np.stack([mark, -mark], -1),
    }
    return StepRecord(**fields)


write_step = jax.jit(write)
finish_step = jax.jit(finish)


@dataclasses.dataclass
class Collected:
    """A replay beside a plain list of what it should hold."""

    replay: Replay
    finished: list[tuple[int, int]]  # (episode, steps) in order of completion, oldest first


def collect(lengths: list[int], capacity: int, steps: int) -> Collected:
    """Episodes of the given numbers of steps, handed out in turn to the environments; some are open at the end."""
    queue = list(enumerate(lengths))
    current = np.array([queue.pop(0) for _ in range(NUM_ENVS)])
    position = np.zeros(NUM_ENVS, int)
    first = record_of(current[:, 0], position, current[:, 1])
    replay = write_step(init_replay(first, capacity, HORIZON), first, jnp.asarray(position))
    finished = []
    for _ in range(steps):
        position += 1
        replay = write_step(replay, record_of(current[:, 0], position, current[:, 1]), jnp.asarray(position))
        done = position == current[:, 1]
        replay = finish_step(replay, jnp.asarray(done), jnp.asarray(position + 1))
        for env in np.flatnonzero(done):
            finished.append((int(current[env, 0]), int(current[env, 1])))
            current[env], position[env] = queue.pop(0), 0
        first = record_of(current[:, 0], position, current[:, 1])
        replay = write_step(replay, first, jnp.asarray(position), jnp.asarray(done))
    return Collected(replay, finished)


NUM_STEPS = 12
episode_lengths = st.lists(st.integers(1, HORIZON), min_size=NUM_ENVS * (NUM_STEPS + 1),
                           max_size=NUM_ENVS * (NUM_STEPS + 1))


def stored(replay: Replay) -> list[tuple[int, int]]:
    """(episode, steps) of all that can be sampled, oldest first, after checking every step of each."""
    replay = jax.device_get(replay)
    count, capacity = int(replay.count), replay.capacity
    order = range(count) if count < capacity else (i % capacity for i in range(count, count + capacity))
    found = []
    for slot in np.asarray(replay.finished)[list(order)]:
        length = int(replay.length[slot])
        data = jax.tree.map(lambda x, slot=slot, length=length: np.asarray(x[slot, :length]), replay.data)
        episode = int(data.reward[0]) // 10
        steps = np.arange(length)
        expected = record_of(np.full(length, episode), steps, np.full(length, length - 1))
        jax.tree.map(np.testing.assert_array_equal, data, expected)
        found.append((episode, length - 1))
    return found


@quick
@given(episode_lengths, st.sampled_from([NUM_ENVS, NUM_ENVS + 2]))
def test_the_latest_finished_episodes_come_back_exactly_as_written(lengths: list[int], capacity: int):
    collected = collect(lengths, capacity, NUM_STEPS)
    assert stored(collected.replay) == collected.finished[-capacity:]
    assert int(collected.replay.count) == len(collected.finished)
    finished = collected.replay.finished[: len(collected.finished)].tolist()
    slots = finished + collected.replay.open_slots.tolist()
    assert len(set(slots)) == len(slots)  # an open episode's slot is nobody else's


sample = jax.jit(sample_episodes, static_argnums=2)


@quick
@given(episode_lengths)
def test_every_finished_episode_is_sampled_and_no_open_one(lengths: list[int]):
    collected = collect(lengths, NUM_ENVS + 2, NUM_STEPS)
    slots = np.asarray(sample(collected.replay, jax.random.key(len(collected.finished)), 256))
    episodes = {int(reward) // 10 for reward in np.asarray(collected.replay.data.reward)[slots, 0]}
    assert episodes == {episode for episode, _ in collected.finished[-NUM_ENVS - 2 :]}


def test_sampling_is_uniform_over_episodes_whatever_their_length():
    replay = collect([1, 4, 1, 4, 4, 4, 4] + [4] * 30, 4, 5).replay
    lengths = [steps for _, steps in stored(replay)]
    assert set(lengths) == {1, 4}
    slots = np.asarray(sample(replay, jax.random.key(0), 10_000))
    counts = np.bincount(slots)[np.asarray(replay.finished)]
    np.testing.assert_allclose(counts / 10_000, 1 / len(lengths), atol=4 * np.sqrt(0.25 / 10_000))


@pytest.mark.parametrize("kept", [1, 2, 3])
def test_kept_episodes_stay_and_have_their_share(kept: int):
    replay = init_replay(record_of(np.zeros(NUM_ENVS, int), np.zeros(NUM_ENVS, int), np.ones(NUM_ENVS, int)),
                         kept + NUM_ENVS + 1, HORIZON, kept)
    seen, step = [], jax.jit(finish)
    for _ in range(9):
        seen.append(replay.open_slots.tolist())
        replay = step(replay, jnp.ones(NUM_ENVS, bool), jnp.ones(NUM_ENVS, jnp.int32))
    ring = replay.finished.tolist()
    assert ring[:kept] == seen[0][:kept]
    assert len(set(ring + replay.open_slots.tolist())) == len(ring) + NUM_ENVS
    last = [slot for slots in seen for slot in slots][-(len(ring) - kept):]
    assert sorted(ring[kept:]) == sorted(last)
    drawn = np.asarray(jax.jit(sample_episodes, static_argnums=(2, 3))(replay, jax.random.key(0), 4000, 0.5))
    expected = 0.5 + 0.5 * kept / len(ring)
    np.testing.assert_allclose(np.isin(drawn, ring[:kept]).mean(), expected, atol=0.04)
    unkept = dataclasses.replace(replay, kept=0)  # such as Believer's before it learns: no share of nothing
    drawn = np.asarray(jax.jit(sample_episodes, static_argnums=(2, 3))(unkept, jax.random.key(0), 4000, 0.5))
    np.testing.assert_allclose(np.isin(drawn, ring[:kept]).mean(), kept / len(ring), atol=0.04)
    with pytest.raises(ValueError, match="beside 9 that are kept"):
        init_replay(jax.tree.map(lambda x: x[:, 0], replay.data), 9, HORIZON, 9)


@pytest.mark.parametrize("steps", [1, 2, 3, 12])
def test_the_halves_of_a_batch_come_from_two_folds_of_the_replay(steps: int):
    """Of 1, 2, 3 and 5 episodes: those at even places of the ring, and those at odd ones."""
    replay = collect([1, 9, 9] + [1] * 60, NUM_ENVS + 2, steps).replay
    places = np.asarray(replay.finished)[: int(replay.count)].tolist()
    halves = np.asarray(sample(replay, jax.random.key(0), 256)).reshape(2, -1)
    assert set(halves[0].tolist()) == set(places[::2])
    assert set(halves[1].tolist()) == set(places[1::2] or places)


def test_all_environments_end_at_once_in_the_smallest_replay():
    for rounds in (1, 2, 3, 5):
        collected = collect([2] * 60, NUM_ENVS, 2 * rounds)
        assert len(collected.finished) == NUM_ENVS * rounds
        assert stored(collected.replay) == collected.finished[-NUM_ENVS:]


def test_too_small_a_replay_is_refused():
    example = record_of(np.arange(NUM_ENVS), np.zeros(NUM_ENVS, int), np.ones(NUM_ENVS, int))
    with pytest.raises(ValueError, match="2 episodes cannot serve 3 environments"):
        init_replay(example, NUM_ENVS - 1, HORIZON)


# Packing

ROW, BATCH = 10, 8
fit = jax.jit(first_fit, static_argnums=1)


def first_fit_reference(lengths: list[int]) -> list[tuple[int, int]]:
    """(row, offset) of each episode: the longest first, each in the first row that has room."""
    used, places = [0] * len(lengths), [(0, 0)] * len(lengths)
    for i in sorted(range(len(lengths)), key=lambda i: -lengths[i]):
        row = next(r for r in range(len(lengths)) if used[r] + lengths[i] <= ROW)
        places[i] = row, used[row]
        used[row] += lengths[i]
    return places


@quick
@given(st.lists(st.integers(1, ROW), min_size=BATCH, max_size=BATCH))
def test_first_fit(lengths: list[int]):
    layout = fit(jnp.array(lengths, jnp.int32), ROW)
    taken = np.zeros((BATCH, ROW), int)
    for row, offset, length in zip(layout.row.tolist(), layout.offset.tolist(), lengths, strict=True):
        assert 0 <= offset <= ROW - length
        taken[row, offset : offset + length] += 1
    assert taken.max() == 1
    assert taken.sum() == sum(lengths)
    assert taken.any(axis=1).tolist() == [row < int(layout.num_rows) for row in range(BATCH)]
    assert list(zip(layout.row.tolist(), layout.offset.tolist(), strict=True)) == first_fit_reference(lengths)


def test_folds_are_packed_into_rows_of_their_own():
    lengths = [4, 6, 10, 5, 3, 3, 3, 1]
    layout = fit_folds(jnp.array(lengths, jnp.int32), ROW)
    assert int(layout.num_rows) == 3
    stacked = stack_folds(layout, 3)
    assert stacked.row.tolist() == [1, 1, 0, 2, 3, 3, 3, 3]
    assert stacked.offset.tolist() == [6, 0, 0, 0, 0, 3, 6, 9]


@pytest.mark.parametrize("batch", [1, 2, 4, 7, 64])
def test_row_choices_end_with_a_row_per_episode(batch: int):
    choices = row_choices(batch)
    assert choices == tuple(sorted(set(choices)))
    assert choices[0] >= 1
    assert choices[-1] == batch


@pytest.fixture(scope="module")
def replay() -> Replay:
    return collect([3, 1, 4, 2, 2, 4, 1, 3] + [4] * 20, 8, 8).replay


@pytest.mark.parametrize("is_packed", [True, False])
def test_gather_rows(replay: Replay, is_packed: bool):
    """Rows of a shuffled batch with a repeated episode, against a loop over tokens."""
    slots = np.asarray(replay.finished)[[3, 0, 2, 3, 1]]
    lengths, row_length = np.asarray(replay.length)[slots], HORIZON + 1
    layout = fit(jnp.asarray(lengths), row_length) if is_packed else one_per_row(len(slots))
    rows = len(slots)
    gather = jax.jit(gather_rows, static_argnums=(3, 4))
    tokens = gather(replay, jnp.asarray(slots), layout, rows, None)
    frames = np.asarray(tokens.frames)
    assert tokens.frame is None
    assert len(frames) == rows * row_length
    segment = np.zeros((rows, row_length), int)
    for episode, slot in enumerate(slots):
        for step in range(lengths[episode]):
            place = int(layout.row[episode]), int(layout.offset[episode]) + step
            segment[place] = episode + 1
            assert tokens.position[place] == step
            np.testing.assert_array_equal(frames[place[0] * row_length + place[1]], replay.data.observation[slot, step])
            for field in ("previous_action", "reward", "terminated", "truncated", "z_s"):
                np.testing.assert_array_equal(
                    np.asarray(getattr(tokens, field))[place], np.asarray(getattr(replay.data, field))[slot, step])
    np.testing.assert_array_equal(tokens.segment, segment)
    padding = segment == 0
    assert (np.asarray(tokens.previous_action)[padding] == -1).all()
    assert not np.asarray(tokens.position)[padding].any()
