"""What each motion and each set of unknowns allows: ranks from Lie derivatives, and how a Gramian fades."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from vical_mocks.points import board_points
from vical_mocks.rig import reference_rig
from vical_mocks.trajectory import Trajectory, constant_rate, hand_motion, one_axis, pure_translation

from benchmarks.observability_model import ModelBlocks, model_rank
from vical_daemon.estimation.tools.observability import Motion, Setup, covariance_of, gramian

FloatArray = npt.NDArray[np.float64]

MODELS = {
    "known target": ModelBlocks(),
    "known target, lens": ModelBlocks(intrinsics=True),
    "known target, IMU matrices": ModelBlocks(imu_matrix=True),
    "known target of unknown size": ModelBlocks(target_scale=True),
    "known target, readout of rows": ModelBlocks(readout=True),
    "no target, gravity known": ModelBlocks(target_free=True, gravity="known"),
    "no target, direction of gravity unknown": ModelBlocks(target_free=True, gravity="magnitude"),
    "no target, lens, IMU matrices": ModelBlocks(
        target_free=True, gravity="known", intrinsics=True, imu_matrix=True
    ),
    "no target, readout of rows": ModelBlocks(target_free=True, gravity="known", readout=True),
}


def study_models() -> None:
    """Rank and what is lost, for each model and motion."""
    print("\n### Rank of the Lie derivatives (unknowns in brackets); blocks that the lost directions touch\n")
    print("| unknowns | motion | rank | lost |\n|---|---|---|---|")
    for name, blocks in MODELS.items():
        for motion in ("general", "one_axis", "translation", "constant"):
            result = model_rank(blocks, motion)
            names = np.array(result.names)
            lost = [
                n
                for n in dict.fromkeys(result.names)
                if np.linalg.norm(result.null_space[:, names == n]) > 1e-6
            ]
            print(
                f"| {name} | {motion} | {result.rank} ({result.unknowns}) | {', '.join(lost) or 'nothing'} |"
            )


def sampled(trajectory: Trajectory, gravity: FloatArray, seconds: float) -> Motion:
    """A trajectory as the Gramian wants it."""
    t = np.arange(0.0, seconds, 0.005)
    R = trajectory.R_world_imu(t)
    force = np.einsum("kji,kj->ki", R, trajectory.a_world_imu(t) - gravity)
    return Motion(
        t, R, trajectory.p_world_imu(t), trajectory.v_world_imu(t), trajectory.omega_imu_rps(t), force
    )


def study_motions(seconds: float) -> None:
    """Bounds along simulated motions before a board."""
    rig = reference_rig(1)
    mounted = (rig.R_imu_cam, rig.p_imu_cam)
    motions = {
        "hand, 55 deg/s": hand_motion(1, 55.0, T_imu_cam=mounted),
        "hand, 10 deg/s": hand_motion(1, 10.0, T_imu_cam=mounted),
        "one axis: optical": one_axis(1, [0, 0, 1], T_imu_cam=mounted),
        "one axis: image x": one_axis(1, [1, 0, 0], T_imu_cam=mounted),
        "translation only": pure_translation(1, T_imu_cam=mounted),
        "constant rate": constant_rate(T_imu_cam=mounted),
    }
    lens = rig.lens
    setup = Setup(
        rig.R_imu_cam, rig.p_imu_cam, np.array(lens.intrinsics), np.array(lens.distortion), board_points(),
        model=lens.model, resolution=lens.resolution,
    )  # fmt: skip
    print(f"\n### Bounds along {seconds:.0f} s of motion, perfect imu, 48 corners of 0.5 px at 20 Hz\n")
    print(
        "| motion | rank | lever arm mm (camera axes) | mounting deg (camera axes) | delay us |"
        "\n|---|---|---|---|---|"
    )
    for name, trajectory in motions.items():
        motion = sampled(trajectory, rig.gravity_world_mps2, seconds)
        result = gramian(motion, setup, np.arange(0, len(motion.t_s), 10))
        covariance = covariance_of(result, 1e4)
        arm = covariance[result.blocks["lever_arm"], result.blocks["lever_arm"]]
        arm_mm = 1e3 * np.sqrt(np.diagonal(rig.R_imu_cam.T @ arm @ rig.R_imu_cam))
        turn = np.rad2deg(np.sqrt(np.diagonal(covariance)[result.blocks["rotation"]]))
        delay = 1e6 * float(np.sqrt(covariance[result.blocks["timeshift"], result.blocks["timeshift"]][0, 0]))
        words = [" / ".join("lost" if v > limit else f"{v:.3f}" for v in values)
                 for values, limit in ((arm_mm, 1e3), (turn, 30.0), ([delay], 1e5))]  # fmt: skip
        print(
            f"| {name} | {result.rank} of {result.unknowns} | {words[0]} | {words[1]} | {words[2]} |",
            flush=True,
        )


def figure(path: Path) -> None:
    """Draw how the singular values fall, for a general and for a one-axis motion."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    drawing, axes = plt.subplots(figsize=(7.0, 3.2))
    for motion, mark in (("general", "o"), ("one_axis", "s"), ("translation", "^")):
        s = model_rank(ModelBlocks(), motion).singular_values
        axes.semilogy(np.arange(1, len(s) + 1), np.maximum(s / s[0], 1e-18), mark, markersize=4, label=motion)
    axes.set_xlabel("singular value of the Lie derivatives, known target")
    axes.set_ylabel("relative size")
    axes.legend()
    drawing.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    drawing.savefig(path, dpi=110)
    plt.close(drawing)
    print(f"wrote {path}")


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks observability", description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--figure", type=Path, help="only draw the figure there")
    args = parser.parse_args(list(argv))
    if args.figure is not None:
        figure(args.figure)
        return 0
    study_models()
    study_motions(args.seconds)
    return 0
