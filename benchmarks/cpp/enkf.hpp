// Ensemble Kalman filter with perturbed observations; the density of an observation is the mean of
// its densities given the members.
#pragma once
#include "ensemble.hpp"

template <class Model>
double enkf(const Model& model, const Record& record, const double* normals, int64_t N) {
    Noise noise(normals, N);
    Ensemble<Model> ensemble(model, N, noise);
    const std::vector<double> equal(N, 1.0 / N);
    std::vector<double> log_w(N), w(N);
    double total = 0.0;
    int64_t k = 0;
    for (int64_t j = 0; j < record.n_observations; ++j) {
        for (; k < record.steps[j]; ++k) ensemble.propagate(model, record.inputs[k], noise);
        log_density(model, record.observed[j], ensemble, log_w);
        total += normalise(log_w, w) - std::log(N);
        nudge(model, record.observed[j], equal, noise, ensemble);
    }
    return total;
}
