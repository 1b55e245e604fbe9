"""Axioms of the rotation functions, near the identity, in between, and near half a turn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from deploy import so3

RNG = np.random.default_rng(0)
ANGLES = (0.0, 1e-9, 5e-4, 2e-3, 0.1, 1.0, 3.0, math.pi - 1e-6)


def vector(angle: float) -> np.ndarray:
    axis = RNG.normal(size=3)
    return axis / np.linalg.norm(axis) * angle


@pytest.mark.parametrize("angle", ANGLES)
def test_log_inverts_exp(angle):
    for _ in range(10):
        phi = vector(angle)
        np.testing.assert_allclose(so3.log(so3.quaternion(phi)), phi, atol=1e-9)
        np.testing.assert_allclose(so3.log(-so3.quaternion(phi)), phi, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_a_rotation_about_its_axis(angle):
    phi = vector(angle)
    C = so3.exp(phi)
    np.testing.assert_allclose(C @ C.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(C) == pytest.approx(1.0)
    np.testing.assert_allclose(C @ phi, phi, atol=1e-12)
    assert np.trace(C) == pytest.approx(1.0 + 2.0 * math.cos(angle))
    np.testing.assert_allclose(so3.exp(-phi), C.T, atol=1e-12)


def test_exp_is_the_series_of_the_skew_matrix():
    phi = vector(1.3)
    term, total = np.eye(3), np.eye(3)
    for k in range(1, 30):
        term = term @ so3.skew(phi) / k
        total = total + term
    np.testing.assert_allclose(so3.exp(phi), total, atol=1e-12)


def test_product_of_quaternions_is_that_of_matrices():
    for _ in range(10):
        p, q = so3.quaternion(vector(2.0)), so3.quaternion(vector(0.7))
        np.testing.assert_allclose(so3.matrix(so3.multiply(p, q)), so3.matrix(p) @ so3.matrix(q), atol=1e-12)


def test_skew_is_the_cross_product():
    a, b = RNG.normal(size=(2, 5, 3))
    np.testing.assert_allclose((so3.skew(a) @ b[:, :, None])[:, :, 0], np.cross(a, b), atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 9.9e-4, 1.01e-3, 0.02, 1.0, 3.0])
def test_integrals_by_quadrature(angle):
    phi, n = vector(angle), 1000
    turns = np.array([so3.exp((k + 0.5) / n * phi) for k in range(n)])
    first, second = so3.integrals(phi)
    np.testing.assert_allclose(first, turns.mean(0), atol=1e-6)
    # the double integral is that of (1 - s) exp(s phi)
    left = 1.0 - (np.arange(n) + 0.5) / n
    np.testing.assert_allclose(second, np.einsum("n,nij->ij", left, turns) / n, atol=1e-6)


def test_aligning_turns_one_vector_into_the_other():
    up = np.array([0.0, 0.0, 1.0])
    cases = [up, -up, *np.eye(3), *(vector(1.0) for _ in range(10))]
    for a in cases:
        q = so3.aligning(a, up)
        assert np.linalg.norm(q) == pytest.approx(1.0)
        np.testing.assert_allclose(so3.matrix(q) @ a, up, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_turned_is_a_product_of_quaternions(angle):
    q, phi = so3.quaternion(vector(2.0)), vector(angle)
    for world, expected in (
        (False, so3.multiply(q, so3.quaternion(phi))),
        (True, so3.multiply(so3.quaternion(phi), q)),
    ):
        found, C = so3.turned(q, phi, world)
        np.testing.assert_allclose(found, expected, atol=1e-15)
        np.testing.assert_allclose(C, so3.matrix(expected), atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-5, 9.9e-4, 1.01e-3, 0.02, 1.0, 3.0])
def test_carried_is_the_integrals_times_a_vector(angle):
    phi, f = vector(angle), RNG.normal(size=3)
    for found, matrix in zip(so3.carried(phi, f), so3.integrals(phi), strict=True):
        np.testing.assert_allclose(found, matrix @ f, atol=1e-14)


def test_rotated_is_the_product_of_matrix_and_vector():
    C, a = RNG.normal(size=(3, 3)), RNG.normal(size=3)
    np.testing.assert_allclose(so3.rotated(C.tolist(), a.tolist()), C @ a, atol=1e-15)
