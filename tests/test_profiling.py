"""profiling: every second is counted once, by kind of work and by block, and what waits is no processor time."""

import dataclasses as dc
import threading

import pytest

from valve_drake import profiling


class Clocks:
    """The wall's and the processor's clocks, moved by hand."""

    def __init__(self):
        self.wall = self.thread = self.process = 0.0

    def burn(self, seconds, slower=1.0):
        """Work of this thread; slower: others have the processor in between."""
        self.wall += slower * seconds
        self.thread += seconds
        self.process += seconds

    def burn_elsewhere(self, seconds):
        """Work of another thread while this one waits."""
        self.wall += seconds
        self.process += seconds


@pytest.fixture
def clocks(monkeypatch):
    clocks = Clocks()
    monkeypatch.setattr(profiling.time, "perf_counter", lambda: clocks.wall)
    monkeypatch.setattr(profiling.time, "thread_time", lambda: clocks.thread)
    monkeypatch.setattr(profiling.time, "process_time", lambda: clocks.process)
    return clocks


@pytest.mark.parametrize("slower", [1.0, 3.0])
def test_inner_work_is_taken_off_the_outer_also_on_a_busy_machine(clocks, slower):
    with profiling.measure() as profile:
        with profiling.advance():
            clocks.burn(3, slower)
            with profiling.work(profiling.STAGE, "eyes"):
                clocks.burn(1, slower)
                with profiling.work(profiling.IMAGES):
                    clocks.burn(2, slower)
            with profiling.work(profiling.LOGGING):
                clocks.burn(4, slower)
        spent = profile.spent()
    assert spent.stages == {"eyes": pytest.approx(1)}
    assert (spent.images, spent.logging, spent.framework) == pytest.approx((2, 4, 3))
    assert spent.plant is None and "plant" not in spent.parts()
    assert spent.total == pytest.approx(10)


def test_what_waits_is_no_processor_time(clocks):
    with profiling.measure() as profile:
        with profiling.advance():
            with profiling.work(profiling.STAGE, "a"):
                clocks.burn(2)
            with profiling.work(profiling.IMAGES):
                clocks.burn(1)
                with profiling.work(profiling.WAITING):
                    clocks.wall += 50
        spent = profile.spent()
    assert (spent.waited, spent.images, spent.stages["a"]) == pytest.approx((50, 1, 2))
    assert spent.total == pytest.approx(3)


def test_a_plant_that_says_its_time_stands_apart_from_the_framework(clocks):
    with profiling.measure() as profile:
        with profiling.advance():
            clocks.burn(1)
            with profiling.work(profiling.PLANT):
                clocks.burn(2)
        spent = profile.spent()
    assert (spent.plant, spent.framework) == pytest.approx((2, 1))
    assert (spent.parts()["plant"], spent.parts()["framework"]) == pytest.approx((2, 1))


def test_phases_other_threads_and_other_processes_add_up(clocks):
    with profiling.measure() as profile:
        clocks.burn(1)
        profile.ends(profiling.START_UP)
        with profiling.advance():
            clocks.burn(2)
            clocks.burn_elsewhere(5)
        clocks.burn(4)
        profile.writing = 3.0
        profile.ends(profiling.ADVANCES)
        profile.renderers_start_up, profile.rendering = 6.0, 7.0
        clocks.burn(8)
        profile.ends(profiling.END)
        spent = dc.replace(profile.spent(), imports=9.0)
    assert (spent.start_up, spent.framework, spent.logging, spent.other, spent.end) == pytest.approx((1, 2, 3, 6, 8))
    assert spent.total == pytest.approx(clocks.process + 6 + 7 + 9)
    assert set(spent.as_json()) == {field.name for field in dc.fields(spent)} | {"total"}
    assert spent.as_json()["total"] == pytest.approx(spent.total)


def test_profiles_are_of_one_run_each_and_none_is_kept():
    def elsewhere():
        with profiling.work(profiling.STAGE, "another thread"):
            pass

    elsewhere()
    with profiling.measure() as outer:
        with profiling.measure() as inner, profiling.work(profiling.STAGE, "inner"):
            pass
        thread = threading.Thread(target=elsewhere)
        thread.start()
        thread.join()
        with profiling.work(profiling.STAGE, "outer"):
            pass
    assert [part for _, part in inner.seconds] == ["inner"]
    assert [part for _, part in outer.seconds] == ["outer"]
