// The two systems of systems.py: one Euler-Maruyama step of all members, its Jacobian, the moments
// at step 0. The first state is observed, with variance `gamma`. Members are stored state by state.
#pragma once
#include <array>
#include <cmath>
#include <cstdint>

constexpr double dt = 0.01;

struct DoubleWell {
    static constexpr int n = 1;
    using State = std::array<double, 1>;
    double alpha, beta, sigma, gamma;

    explicit DoubleWell(const double* theta)
        : alpha(theta[0]), beta(theta[1]), sigma(theta[2]), gamma(theta[3]) {}

    State initial_mean() const { return {1.0}; }
    State initial_variance() const { return {0.5}; }
    State noise_variance() const { return {dt * (0.36 + sigma * sigma)}; }

    void step(State& x, double) const { x[0] += dt * (alpha * x[0] + beta * x[0] * x[0] * x[0]); }

    std::array<State, 1> jacobian(const State& x, double) const {
        return {{{1.0 + dt * (alpha + 3.0 * beta * x[0] * x[0])}}};
    }
};

struct MassSpringDamper {
    static constexpr int n = 2;
    using State = std::array<double, 2>;
    double c, c3, k, k2, k3, gain, sigma, gamma, x0;

    explicit MassSpringDamper(const double* theta)
        : c(theta[0]), c3(theta[1]), k(theta[2]), k2(theta[3]), k3(theta[4]), gain(theta[5]),
          sigma(theta[6]), gamma(theta[7]), x0(theta[8]) {}

    State initial_mean() const { return {x0, 0.0}; }
    State initial_variance() const { return {0.1, 0.1}; }
    State noise_variance() const { return {0.0, dt * sigma * sigma}; }

    void step(State& s, double u) const {
        const double x = s[0], v = s[1];
        s[0] = x + dt * v;
        s[1] = v + dt * (gain * u - c * v - c3 * v * v * v - k * x - k2 * x * x - k3 * x * x * x);
    }

    std::array<State, 2> jacobian(const State& s, double) const {
        const double x = s[0], v = s[1];
        return {{{1.0, dt},
                 {-dt * (k + 2.0 * k2 * x + 3.0 * k3 * x * x), 1.0 - dt * (c + 3.0 * c3 * v * v)}}};
    }
};
