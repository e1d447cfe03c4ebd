"""Progress and restarts."""

from __future__ import annotations

from vical_daemon.service.progress import Progress, Restarts


def test_progress_is_what_is_done_not_that_somebody_speaks() -> None:
    progress = Progress()
    assert progress.look(0, 0, 0.0) == 0.0
    assert progress.look(0, 0, 100.0) == 0.0  # nothing comes: nothing to do
    assert progress.look(5, 5, 101.0) == 0.0
    assert progress.look(6, 5, 102.0) == 0.0
    assert progress.look(9, 5, 107.0) == 5.0
    assert progress.look(10, 6, 108.0) == 0.0
    assert progress.look(10, 6, 200.0) == 0.0


def test_an_image_that_waits_while_no_other_comes_is_no_lack_of_progress() -> None:
    """A USB hub was gone for 15 s: the last image has no inertial data, and the estimator started again."""
    progress = Progress()
    progress.look(100, 98, 0.0)
    for k in range(1, 300):
        assert progress.look(102, 98, 0.1 * k) < 0.2
    for k in range(40):  # back, and not one of 12.5 images a second is used
        stuck_s = progress.look(103 + k, 98, 30.0 + 0.08 * k)
    assert abs(stuck_s - 39 * 0.08) < 1e-9
    assert progress.look(142, 98, 40.0) == 0.0
    assert progress.look(143, 100, 40.1) == 0.0


def test_restarts_come_later_and_later_but_not_never() -> None:
    restarts = Restarts()
    pauses = [restarts.failed("why", 1.0 + k) for k in range(12)]
    assert pauses[:5] == [0.0, 1.0, 2.0, 4.0, 8.0] and pauses[-1] == 60.0 and restarts.count == 12
    assert restarts.waiting_s(13.0) == 59.0 and restarts.waiting_s(73.0) == 0.0
    assert restarts.failed("why", 1000.0) == 0.0
