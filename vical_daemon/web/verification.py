"""What the page says of a camera whose stored calibration is verified."""

from __future__ import annotations

from typing import Any

from vical_daemon.bus.messages import CheckState, VerifyResult

_HEADLINES = {
    "holds": "The stored calibration holds.",
    "changed": "The stored calibration no longer holds.",
    "cannot_tell": "Not known yet whether the stored calibration holds.",
}
_STATUS = {"holds": "holds", "changed": "changed", "cannot_tell": "verifying"}


def verification_words(result: VerifyResult) -> dict[str, Any]:
    """Return status, headline, reason and guidance of a camera; {}: the estimator has the word."""
    if result.state in (CheckState.CALIBRATING, CheckState.UNABLE):
        return {}
    missing = list(result.missing_motion) if result.verdict == "cannot_tell" else []
    return {
        "status": _STATUS[result.verdict],
        "headline": _HEADLINES[result.verdict],
        "reason": result.text,
        "guidance": "; ".join(missing),
        "verify": {
            "verdict": result.verdict,
            "state": str(result.state),
            "against": result.against,
            "answered_ns": str(result.answered_ns),
            "probability_changed": result.probability_changed,
            "seconds_used": result.seconds_used,
            "checks": result.checks,
            "changes": [
                {"what": c.block, "value": c.value, "sigma": c.sigma, "axis": list(c.axis)}
                for c in result.changes
            ],
            "missing_motion": list(result.missing_motion),
        },
    }
