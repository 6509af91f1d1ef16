// Extended Kalman filter.
#pragma once
#include "ensemble.hpp"

template <class Model>
double ekf(const Model& model, const Record& record) {
    constexpr int n = Model::n;
    auto x = model.initial_mean();
    const auto variance = model.initial_variance(), Q = model.noise_variance();
    double P[n][n] = {}, total = 0.0;
    for (int a = 0; a < n; ++a) P[a][a] = variance[a];
    int64_t k = 0;
    for (int64_t j = 0; j < record.n_observations; ++j) {
        for (; k < record.steps[j]; ++k) {
            const auto F = model.jacobian(x, record.inputs[k]);
            model.step(x, record.inputs[k]);
            double FP[n][n] = {};
            for (int a = 0; a < n; ++a)
                for (int b = 0; b < n; ++b)
                    for (int c = 0; c < n; ++c) FP[a][b] += F[a][c] * P[c][b];
            for (int a = 0; a < n; ++a)
                for (int b = 0; b < n; ++b) {
                    P[a][b] = a == b ? Q[a] : 0.0;
                    for (int c = 0; c < n; ++c) P[a][b] += FP[a][c] * F[b][c];
                }
        }
        const double S = P[0][0] + model.gamma, residual = record.observed[j] - x[0];
        total -= 0.5 * (std::log(2.0 * M_PI * S) + residual * residual / S);
        double gain[n], row[n];
        for (int a = 0; a < n; ++a) gain[a] = P[a][0] / S, row[a] = P[0][a];
        for (int a = 0; a < n; ++a) {
            x[a] += gain[a] * residual;
            for (int b = 0; b < n; ++b) P[a][b] -= gain[a] * row[b];
        }
    }
    return total;
}
