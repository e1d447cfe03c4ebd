"""Agreement of stretches about the lens: silent on clean data, and the right size when stretches differ."""

import numpy as np

from vical_daemon.estimation.lens_agreement import LensAgreement

LENS = np.array([500.0, 500.0, 320.0, 240.0, -0.2, 0.05, 0.0, 0.0])
SIZE = np.array([1.0, 1.0, 1.0, 1.0, 1e-2, 2e-2, 1e-3, 1e-3])  # what one image of unit noise says, roughly


def run(rng, scatter, stretches=12, images=6):
    """Linear images whose lens changes from stretch to stretch; returns factors and error of the mean."""
    agreement = LensAgreement()
    information, weighted = np.zeros((8, 8)), np.zeros(8)
    for stretch in range(stretches):
        lens = LENS + scatter * SIZE * rng.standard_normal(8)
        for k in range(images):
            by_lens = rng.standard_normal((60, 8)) / SIZE
            by_pose = rng.standard_normal((60, 6))
            pose = 50.0 * rng.standard_normal(6)  # an innovation also holds an error of the pose
            innovation = by_lens @ (lens - LENS) + by_pose @ pose + rng.standard_normal(60)
            agreement.learn(5.0 * stretch + 0.5 * k, innovation, by_pose, by_lens, LENS)
            Q = np.linalg.qr(by_pose)[0]
            J = by_lens - Q @ (Q.T @ by_lens)
            information += J.T @ J
            weighted += J.T @ innovation
    agreement.learn(5.0 * stretches, innovation, by_pose, by_lens, LENS)
    covariance = np.linalg.inv(information)
    return agreement.factors, covariance @ weighted / np.sqrt(np.diag(covariance))


def test_clean_stretches_cost_nothing():
    rng = np.random.default_rng(1)
    factors = np.array([run(rng, 0.0)[0] for _ in range(40)])
    assert (factors >= 1.0).all()
    assert (factors > 1.0).mean() < 0.05  # by chance: one in a hundred, a little more for runs that overlap


def test_stretches_that_differ_are_believed_as_little_as_they_deserve():
    rng = np.random.default_rng(2)
    runs = [run(rng, 0.4) for _ in range(50)]
    z = np.array([error for _, error in runs])
    honest = z / np.sqrt([factors for factors, _ in runs])
    assert (np.abs(z) < 3.0).mean() < 0.75  # taken at its word the filter would be wrong
    assert (np.abs(honest) < 3.0).mean() > 0.97
    assert 0.4 < np.sqrt((honest**2).mean()) < 1.15


def test_two_stretches_are_not_enough_to_say_anything():
    factors, _ = run(np.random.default_rng(3), 1.0, stretches=2)
    np.testing.assert_array_equal(factors, 1.0)


def test_memory_is_bounded():
    agreement = LensAgreement()
    rng = np.random.default_rng(4)
    for k in range(300):
        J, P = rng.standard_normal((20, 8)), rng.standard_normal((20, 6))
        agreement.learn(5.0 * k, rng.standard_normal(20), P, J, LENS)
    assert len(agreement._done) <= 40
    assert np.isfinite(agreement.factors).all()
