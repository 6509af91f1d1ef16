"""Hand-written loops for one system each, the reference for the compiled filters.

They need only numpy and numba, and read a record as arrays.
"""

import math

import numba
import numpy as np

DT = 0.01
by_hand = numba.njit(error_model="numpy", fastmath={"contract", "nsz", "arcp"})


@by_hand
def ekf_double_well(theta, steps, observed):
    """The extended Kalman filter of the double well."""
    alpha, beta, sigma, gamma = theta
    x, P, total, k = 1.0, 0.5, 0.0, 0
    noise = DT * (0.36 + sigma * sigma)
    for j in range(steps.size):
        while k < steps[j]:
            a = 1.0 + DT * (alpha + 3.0 * beta * x * x)
            x = x + DT * (alpha * x + beta * x * x * x)
            P = a * P * a + noise
            k += 1
        S = P + gamma
        v = observed[j, 0] - x
        total += -0.5 * (np.log(2.0 * np.pi * S) + v * v / S)
        K = P / S
        x += K * v
        P = (1.0 - K) * P
    return total


@by_hand
def ekf_mass_spring_damper(theta, steps, observed, inputs):
    """The extended Kalman filter of the mass-spring-damper, all products written out."""
    c, c3, stiffness, k2, k3, gain, sigma, gamma, x0 = theta
    x, v, total, k = x0, 0.0, 0.0, 0
    P00, P01, P11 = 0.1, 0.0, 0.1
    noise = DT * sigma * sigma
    for j in range(steps.size):
        while k < steps[j]:
            a = -DT * (stiffness + 2.0 * k2 * x + 3.0 * k3 * x * x)
            b = 1.0 - DT * (c + 3.0 * c3 * v * v)
            force = gain * inputs[k] - c * v - c3 * v * v * v
            spring = stiffness * x + k2 * x * x + k3 * x * x * x
            x, v = x + DT * v, v + DT * (force - spring)
            Q00, Q01 = P00 + DT * P01, P01 + DT * P11
            Q10, Q11 = a * P00 + b * P01, a * P01 + b * P11
            P00, P01, P11 = Q00 + DT * Q01, a * Q00 + b * Q01, a * Q10 + b * Q11 + noise
            k += 1
        S = P00 + gamma
        r = observed[j, 0] - x
        total += -0.5 * (np.log(2.0 * np.pi * S) + r * r / S)
        K0, K1 = P00 / S, P01 / S
        x, v = x + K0 * r, v + K1 * r
        P11 = P11 - K1 * P01
        P00, P01 = (1.0 - K0) * P00, (1.0 - K0) * P01
    return total


@by_hand
def propagate_double_well(theta, steps, normals, x):
    """Run only the steps of an ensemble x (N,) on stored normals (1 + steps + J, N): no update."""
    alpha, beta, sigma, _ = theta
    scale = math.sqrt(DT * (0.36 + sigma * sigma))
    for i in range(x.size):
        x[i] = 1.0 + math.sqrt(0.5) * normals[0, i]
    for k in range(steps[-1]):
        z = normals[1 + k]
        for i in range(x.size):
            x[i] += DT * (alpha * x[i] + beta * x[i] * x[i] * x[i]) + scale * z[i]
    return x[0]


@by_hand
def propagate_mass_spring_damper(theta, steps, inputs, normals, x, v):
    """Run the same for the mass-spring-damper, on normals (2 + steps + J, N)."""
    c, c3, stiffness, k2, k3, gain, sigma, _, x0 = theta
    scale = math.sqrt(DT) * sigma
    for i in range(x.size):
        x[i] = x0 + math.sqrt(0.1) * normals[0, i]
        v[i] = math.sqrt(0.1) * normals[1, i]
    for k in range(steps[-1]):
        z = normals[2 + k]
        for i in range(x.size):
            s, w = x[i], v[i]
            force = gain * inputs[k] - c * w - c3 * w * w * w
            spring = stiffness * s + k2 * s * s + k3 * s * s * s
            x[i] = s + DT * w
            v[i] = w + DT * (force - spring) + scale * z[i]
    return x[0]


@by_hand
def ode_lynx_hare(theta, steps, observed):
    """Lotka and Volterra's equation by Runge-Kutta steps, with normal errors of the logs."""
    alpha, beta, gamma, delta, hare, lynx, s_hare, s_lynx = theta
    h, total, k = 0.02, 0.0, 0
    for j in range(steps.size):
        while k < steps[j]:
            a, A = (alpha - beta * lynx) * hare, (delta * hare - gamma) * lynx
            x, y = hare + 0.5 * h * a, lynx + 0.5 * h * A
            b, B = (alpha - beta * y) * x, (delta * x - gamma) * y
            x, y = hare + 0.5 * h * b, lynx + 0.5 * h * B
            c, C = (alpha - beta * y) * x, (delta * x - gamma) * y
            x, y = hare + h * c, lynx + h * C
            hare += h / 6.0 * (a + 2.0 * b + 2.0 * c + (alpha - beta * y) * x)
            lynx += h / 6.0 * (A + 2.0 * B + 2.0 * C + (delta * x - gamma) * y)
            k += 1
        u = (observed[j, 0] - math.log(hare)) / s_hare
        v = (observed[j, 1] - math.log(lynx)) / s_lynx
        total -= 0.5 * (u * u + v * v) + math.log(2.0 * math.pi * s_hare * s_lynx)
    return total
