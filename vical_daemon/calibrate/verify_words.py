"""A verification of one camera in words: one line, and its status."""

from __future__ import annotations

from vical_daemon.bus.messages import CheckState, DiagnosticStatus, Level, VerifyResult
from vical_daemon.calibrate.verification import Verification
from vical_daemon.results.verifier import Answer


def line(checks: Verification, camera: str, source: str, age_text: str) -> str:
    """Say whether the calibration holds, what has changed, or what is missing.

    Args:
        checks: The checks.
        camera: Name of the camera.
        source: What is checked.
        age_text: How long ago the last answer was given.
    """
    answer = checks.answers[camera]
    if answer.verdict is Answer.CHANGED:
        return f"{source} no longer holds: {'; '.join(answer.texts)} ({age_text})"
    doubt = "; the last check found a change, which is being confirmed" if checks.suspected else ""
    if answer.verdict is Answer.HOLDS:
        return f"{source} holds ({age_text}, by {answer.seconds:.0f} s of data){doubt}"
    missing = "; ".join(checks.missing(camera)) or "not enough motion with points in view yet"
    return f"cannot tell yet whether {source} holds: {missing}{doubt}"


def age(now_ns: int, then_ns: int) -> str:
    """Say how long ago something was, in steps that do not change each second."""
    if not then_ns:
        return "no answer yet"
    seconds = max(now_ns - then_ns, 0) * 1e-9
    if seconds < 60:
        return "less than a minute ago"
    if seconds < 3600:
        return f"{seconds / 60:.0f} min ago"
    return f"{seconds / 3600:.0f} h ago"


def status(name: str, result: VerifyResult, *, lacks: bool) -> DiagnosticStatus:
    """Return the component `verify/<camera>` of the role's status; `lacks`: a device is silent."""
    bad = lacks or result.verdict == "changed" or result.state is CheckState.UNABLE
    values = {
        "verdict": result.verdict,
        "against": result.against,
        "checks": str(result.checks),
        "seconds_used": f"{result.seconds_used:.0f}",
        "missing_motion": "; ".join(result.missing_motion),
    }
    if result.probability_changed is not None:
        values["probability_changed"] = f"{result.probability_changed:.3g}"
    return DiagnosticStatus(Level.WARN if bad else Level.OK, f"verify/{name}", result.text, "", values)
