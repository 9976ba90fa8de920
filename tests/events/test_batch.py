from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from enerf_ns.events.batch import EventBatch, FrameBatch, TrainBatch


def events(number: int, first: int, silent: bool) -> EventBatch:
    columns = (torch.arange(first + i, first + i + number) for i in range(5))
    return EventBatch(*columns, num_silent=number if silent else 0)


def test_silent_pairs_come_last():
    joined = events(3, 0, False).followed_by(events(2, 100, True))
    assert len(joined) == 5
    assert joined.pixels.tolist() == [0, 1, 2, 100, 101]
    assert joined.off.tolist() == [4, 5, 6, 104, 105]
    assert joined.pixels[joined.fired].tolist() == [0, 1, 2] and joined.pixels[joined.silent].tolist() == [100, 101]


def test_pairs_of_any_instants_come_between_those_of_events_and_silent_ones():
    some = replace(events(2, 100, False), num_any=2)
    joined = events(3, 0, False).followed_by(some).followed_by(events(2, 200, True))
    parts = (joined.of_events, joined.of_any, joined.silent)
    assert [joined.pixels[part].tolist() for part in parts] == [[0, 1, 2], [100, 101], [200, 201]]
    assert joined.num_of_events == 3 and joined.pixels[joined.fired].tolist() == [0, 1, 2, 100, 101]
    subset = joined.subset(torch.tensor([True, False, True, False, True, False, True]))
    parts = (subset.of_events, subset.of_any, subset.silent)
    assert [subset.pixels[part].tolist() for part in parts] == [[0, 2], [101], [201]]


def test_a_subset_knows_which_of_its_pairs_are_silent():
    joined = events(3, 0, False).followed_by(events(2, 100, True))
    subset = joined.subset(torch.tensor([True, False, True, False, True]))
    assert subset.pixels[subset.fired].tolist() == [0, 2] and subset.off[subset.silent].tolist() == [105]


@pytest.mark.parametrize("at_events", [True, False])
def test_a_batch_knows_whether_its_pairs_begin_at_events_whatever_becomes_of_it(at_events: bool):
    joined = replace(events(3, 0, False), starts_at_events=at_events).followed_by(events(2, 100, True))
    assert joined.starts_at_events == joined.subset(joined.off > 4).starts_at_events == at_events


def test_what_is_known_beyond_the_events_stays_with_its_pairs():
    some = replace(events(2, 100, False), ahead=torch.tensor([0.25, -0.5]))
    joined = events(3, 0, False).followed_by(some).followed_by(events(2, 200, True))
    assert joined.ahead is not None and joined.ahead.tolist() == [0, 0, 0, 0.25, -0.5, 0, 0]
    subset = joined.subset(torch.tensor([False, True, False, False, True, True, False])).ahead
    assert subset is not None and subset.tolist() == [0, -0.5, 0]
    assert events(3, 0, False).followed_by(events(2, 100, True)).ahead is None


def test_links_of_chains_are_joined_like_the_pairs_and_left_out_of_subsets():
    of_events = replace(events(5, 0, False), links=events(2, 50, False))
    of_any = replace(events(4, 100, False), num_any=4, links=replace(events(2, 150, False), num_any=2))
    silent = events(2, 200, True)
    joined = of_events.followed_by(of_any).followed_by(silent)
    links = joined.links
    assert links is not None and links.pixels.tolist() == [50, 51, 150, 151]
    assert links.pixels[links.of_any].tolist() == [150, 151]
    assert (joined.num_changes_of_events, joined.num_changes_of_any) == (5 + 2, 4 + 2)
    assert joined.subset(joined.pixels >= 0).links is None
    alone = events(5, 0, False).followed_by(of_any).links
    assert alone is not None and alone.pixels.tolist() == [150, 151] and alone.num_of_events == 0
    assert (silent.links, events(3, 0, False).num_changes_of_events) == (None, 3)


def frames_of(pixels: int, instants: int) -> FrameBatch:
    times = torch.zeros(pixels, instants, dtype=torch.int64)
    return FrameBatch(torch.zeros(pixels, 3, dtype=torch.int64), times, torch.zeros(pixels, 3), False)


def test_what_was_rendered_is_taken_apart_as_its_rays_were_put_together():
    rendered = torch.arange(14.0)[:, None]
    parts = TrainBatch(events(5, 0, False), frames_of(4, 1)).split(rendered)
    assert [part.flatten().tolist() for part in parts] == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9], [10, 11, 12, 13]]


def test_what_a_frame_shows_is_the_mean_over_its_instants():
    rendered = torch.tensor(
        [[0.0, 5.0], [1.0, 5.0], [2.0, 0.0], [4.0, 6.0], [9.0, 0.0], [20.0, 0.0], [1.0, 3.0], [0.0, 0.0]]
    )
    parts = TrainBatch(events(1, 0, False), frames_of(2, 3)).split(rendered)
    assert [part.tolist() for part in parts] == [[[0, 5]], [[1, 5]], [[5, 2], [7, 1]]]


def test_one_instant_is_shown_to_the_bit():
    rendered = torch.rand(100, 3, generator=torch.Generator().manual_seed(0))
    assert (TrainBatch(None, frames_of(100, 1)).split(rendered)[2] == rendered).all()


def test_without_events_all_is_frames_and_without_frames_all_is_events():
    assert [len(part) for part in TrainBatch(None, frames_of(4, 1)).split(torch.zeros(4, 1))] == [0, 0, 4]
    assert [len(part) for part in TrainBatch(events(2, 0, True), None).split(torch.zeros(4, 1))] == [2, 2, 0]
