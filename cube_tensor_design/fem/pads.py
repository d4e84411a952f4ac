"""Mean stress on a pad from the nodal reactions of a finite element solution.

A bonded interface transmits to node i the reaction r_i = int phi_i t ds, with the nodal function
phi_i and the traction t. Finite elements give r as well as they give the energy, while t = sigma n
read off at the interface is poor, worst at the corner of the cube where it is infinite. Here t is
recovered from r:

    find t in T with  int phi_i t ds = r_i  for every node i but the corner's,

T being the element's own polynomials, continued in the last element to the corner (whose reaction
also holds the neighbour face's shear). The integral of t over a pad is then w . r with weights w
that depend on the nodes alone. On a face with two tangential directions the weights are products of
those along each. Linear tractions are returned exactly. Source: M. F. Wheeler, Comp. Meth. Appl.
Mech. Eng. 2 (1973) 123 (consistent fluxes); the treatment of the corner is ours.
"""

from __future__ import annotations

import numpy as np

from cube_tensor_driver.core.arrays import Array


def interval_weights(nodes: Array, order: int, parity: int, start: float, stop: float) -> Array:
    """Weights w (n,) with w . r = integral of the traction from start to stop.

    nodes: (n,) positions on half a face, from the middle 0 to the corner 1; each element has
    `order` equal steps
    parity: +1 when the traction is even about the middle, -1 when it is odd, so zero there
    start, stop: -1 <= start < stop <= 1, ends of elements
    """

    def from_middle(s: float) -> Array:
        """Weights of the integral from the middle to s, which may be on the other half."""
        sign = 1 if s >= 0 else -parity
        return _from_middle(nodes, order, parity, abs(s)) * sign

    return from_middle(stop) - from_middle(start)


def face_weights(nodes: Array, order: int, start: float, stop: float) -> Array:
    """The same for all of a face: nodes (n,) from corner to corner, -1 to 1, symmetric about the
    middle. The forces are split into an even and an odd part.
    """
    half = len(nodes) // 2
    even, odd = (interval_weights(nodes[half:], order, sign, start, stop) for sign in (1, -1))
    weights = np.zeros(len(nodes))
    weights[half:] = (even + odd) / 2
    weights[half::-1] += (even - odd) / 2
    weights[half] = even[0] / 2  # the middle node belongs to both halves
    return weights


def _from_middle(nodes: Array, order: int, parity: int, stop: float) -> Array:
    """Weights of the integral from 0 to stop: solve (int phi_i t_j)^T w = int_0^stop t_j."""
    n = len(nodes)
    mass, integral = np.zeros((n, n)), np.zeros(n)
    element_mass, element_integral = _line_element(order)
    for i in range(0, n - 1, order):
        length = nodes[i + order] - nodes[i]
        mass[i : i + order + 1, i : i + order + 1] += length * element_mass
        if nodes[i + order] <= stop * (1 + 1e-12):
            integral[i : i + order + 1] += length * element_integral
    # An odd traction is zero in the middle, and the mirror plane holds the node there.
    keep = slice(0 if parity > 0 else 1, n - 1)
    trial = np.eye(n)[:, keep]
    trial[-1, -order:] = _continuation(order)
    weights = np.zeros(n)
    weights[keep] = np.linalg.solve((mass @ trial)[keep].T, trial.T @ integral)
    return weights


def _line_element(order: int) -> tuple[Array, Array]:
    """Mass matrix and integrals of the nodal polynomials of order + 1 equal nodes on [0, 1]."""
    s, weight = np.polynomial.legendre.leggauss(order + 1)
    s, weight = (s + 1) / 2, weight / 2
    to_nodal = np.linalg.inv(np.vander(np.arange(order + 1) / order, increasing=True))
    phi = np.vander(s, order + 1, increasing=True) @ to_nodal
    return (phi * weight[:, None]).T @ phi, weight @ phi


def _continuation(order: int) -> Array:
    """Value at the end of an element of the polynomial through its other nodes."""
    powers = np.vander(np.arange(order) / order, increasing=True)
    return np.ones(order) @ np.linalg.inv(powers)
