// Particle filter with an ensemble Kalman proposal; kernel densities by the exact double loop.
#pragma once
#include "ensemble.hpp"

// Lower Cholesky factor of the weighted covariance times N_eff^{-1/(n+4)}.
template <class Model>
struct Bandwidth {
    static constexpr int n = Model::n;
    double H[n][n] = {};

    Bandwidth(const std::vector<double>& w, const Ensemble<Model>& ensemble) {
        double squares = 0.0;
        for (double v : w) squares += v * v;
        const double scott = std::pow(1.0 / squares, -1.0 / (n + 4));
        for (int a = 0; a < n; ++a)
            for (int b = 0; b <= a; ++b) {
                double sum = weighted_covariance(w, ensemble.x[a], ensemble.x[b]);
                for (int c = 0; c < b; ++c) sum -= H[a][c] * H[b][c];
                H[a][b] = a == b ? std::sqrt(sum) : sum / H[b][b];
            }
        for (auto& row : H)
            for (double& h : row) h *= scott;
    }

    double log_constant() const {
        double sum = -0.5 * n * std::log(2.0 * M_PI);
        for (int a = 0; a < n; ++a) sum -= std::log(H[a][a]);
        return sum;
    }

    // H^-1 x / sqrt(2), so that the exponent is a plain squared distance.
    void whiten(const Ensemble<Model>& from, std::vector<double> (&to)[n]) const {
        for (int a = 0; a < n; ++a) {
            to[a].resize(from.N);
            for (int64_t i = 0; i < from.N; ++i) {
                double value = std::sqrt(0.5) * from.x[a][i];
                for (int b = 0; b < a; ++b) value -= H[a][b] * to[b][i];
                to[a][i] = value / H[a][a];
            }
        }
    }
};

// Log-density at every target. One pass of plain exponentials; where they underflow, a second pass
// relative to the largest exponent.
template <class Model>
void log_kernel_density(const std::vector<double>& w, const Ensemble<Model>& members,
                        const Ensemble<Model>& targets, std::vector<double>& out) {
    constexpr int n = Model::n;
    const int64_t N = members.N;
    const Bandwidth<Model> bandwidth(w, members);
    std::vector<double> y[n], v[n];
    bandwidth.whiten(members, y);
    bandwidth.whiten(targets, v);
    const double constant = bandwidth.log_constant();
    const double* weight = w.data();
    const double* source[n];
    for (int a = 0; a < n; ++a) source[a] = y[a].data();
    for (int64_t t = 0; t < N; ++t) {
        double at[n];
        for (int a = 0; a < n; ++a) at[a] = v[a][t];
        const auto half_square = [&](int64_t i) {
            double q = 0.0;
            for (int a = 0; a < n; ++a) q += (source[a][i] - at[a]) * (source[a][i] - at[a]);
            return q;
        };
        double sum = 0.0, smallest = 0.0;
        for (int64_t i = 0; i < N; ++i) sum += weight[i] * std::exp(-half_square(i));
        if (sum < 1e-280) {
            smallest = half_square(0);
            for (int64_t i = 1; i < N; ++i) {
                const double q = half_square(i);
                smallest = q < smallest ? q : smallest;
            }
            sum = 0.0;
            for (int64_t i = 0; i < N; ++i) sum += weight[i] * std::exp(smallest - half_square(i));
        }
        out[t] = constant + std::log(sum) - smallest;
    }
}

template <class Model>
void resample_systematically(double uniform, const std::vector<double>& w,
                             Ensemble<Model>& ensemble) {
    const Ensemble<Model> parents = ensemble;
    double cumulated = w[0];
    int64_t parent = 0;
    for (int64_t i = 0; i < ensemble.N; ++i) {
        const double point = (i + uniform) / ensemble.N;
        while (cumulated < point && parent + 1 < ensemble.N) cumulated += w[++parent];
        for (int a = 0; a < Model::n; ++a) ensemble.x[a][i] = parents.x[a][parent];
    }
}

template <class Model>
double pf_enkf(const Model& model, const Record& record, const double* normals,
               const double* uniforms, int64_t N) {
    Noise noise(normals, N);
    Ensemble<Model> ensemble(model, N, noise);
    const std::vector<double> equal(N, 1.0 / N);
    std::vector<double> w(equal), log_w(N, -std::log(N)), scratch(N), forecast_w(N);
    std::vector<double> log_p(N), log_prior(N), log_proposal(N);
    double total = 0.0;
    int64_t k = 0;
    for (int64_t j = 0; j < record.n_observations; ++j) {
        const double d = record.observed[j];
        for (; k < record.steps[j]; ++k) ensemble.propagate(model, record.inputs[k], noise);

        // Predicted density of the observation, by the previous weights
        log_density(model, d, ensemble, log_p);
        for (int64_t i = 0; i < N; ++i) forecast_w[i] = log_w[i] + log_p[i];
        total += normalise(forecast_w, scratch);

        // Proposal and weights
        const Ensemble<Model> forecast = ensemble;
        nudge(model, d, w, noise, ensemble);
        log_density(model, d, ensemble, log_p);
        log_kernel_density(w, forecast, ensemble, log_prior);
        log_kernel_density(equal, ensemble, ensemble, log_proposal);
        for (int64_t i = 0; i < N; ++i) log_w[i] = log_p[i] + log_prior[i] - log_proposal[i];
        normalise(log_w, w);

        // Resampling
        double squares = 0.0;
        for (double v : w) squares += v * v;
        if (1.0 / squares < N / 3.0) {
            resample_systematically(uniforms[j], w, ensemble);
            w = equal;
            log_w.assign(N, -std::log(N));
        }
    }
    return total;
}
