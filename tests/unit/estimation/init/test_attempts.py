"""attempts.py: when a start is tried."""

import numpy as np

from vical_daemon.estimation.init.attempts import Attempts


def test_attempts_come_ever_less_often_and_often_again_for_new_data():
    attempts = Attempts(first_s=0.5)
    for begin_s in (0.0, 100.0):
        made = []
        for t_s in np.arange(begin_s, begin_s + 60.0, 0.01):
            if attempts.due(t_s):
                attempts.tried(t_s)
                made.append(t_s)
        pauses = np.diff(made)
        assert made[0] == begin_s
        assert attempts.count == len(made)
        assert abs(pauses[0] - 0.5) < 0.02
        assert (np.diff(pauses) > -0.02).all()
        assert abs(pauses[-1] - 4.0) < 0.02
        attempts.anew()
