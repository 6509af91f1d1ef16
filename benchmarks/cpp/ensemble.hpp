// What the ensemble filters share: the record, stored noise, propagation, weighted moments.
#pragma once
#include <cmath>
#include <cstdint>
#include <vector>

struct Record {
    const int64_t* steps;    // of the observations, increasing
    int64_t n_observations;
    const double* observed;  // one per observation
    const double* inputs;    // one per step
};

// Standard normals in the order of their use: initial, then process and observation noise.
class Noise {
  public:
    Noise(const double* stored, int64_t n_members) : next_(stored), n_members_(n_members) {}
    const double* row() {
        const double* row = next_;
        next_ += n_members_;
        return row;
    }

  private:
    const double* next_;
    int64_t n_members_;
};

template <class Model>
struct Ensemble {
    static constexpr int n = Model::n;
    int64_t N;
    std::vector<double> x[n];

    Ensemble(const Model& model, int64_t n_members, Noise& noise) : N(n_members) {
        for (int a = 0; a < n; ++a) {
            const double mean = model.initial_mean()[a];
            const double sd = std::sqrt(model.initial_variance()[a]);
            const double* z = noise.row();
            x[a].resize(N);
            for (int64_t i = 0; i < N; ++i) x[a][i] = mean + sd * z[i];
        }
    }

    // One step of every member. One of the states is driven by noise.
    void propagate(const Model& model, double input, Noise& noise) {
        const double* z = noise.row();
        const auto variance = model.noise_variance();
        double sd[n];
        double* members[n];
        for (int a = 0; a < n; ++a) {
            sd[a] = std::sqrt(variance[a]);
            members[a] = x[a].data();
        }
        for (int64_t i = 0; i < N; ++i) {
            typename Model::State s;
            for (int a = 0; a < n; ++a) s[a] = members[a][i];
            model.step(s, input);
            for (int a = 0; a < n; ++a) members[a][i] = s[a] + sd[a] * z[i];
        }
    }
};

inline double weighted_mean(const std::vector<double>& w, const std::vector<double>& x) {
    double sum = 0.0;
    for (size_t i = 0; i < x.size(); ++i) sum += w[i] * x[i];
    return sum;
}

// Unbiased for equal weights: the sum is divided by 1 - sum of squared weights.
inline double weighted_covariance(const std::vector<double>& w, const std::vector<double>& x,
                                  const std::vector<double>& y) {
    const double x_mean = weighted_mean(w, x), y_mean = weighted_mean(w, y);
    double sum = 0.0, squares = 0.0;
    for (size_t i = 0; i < x.size(); ++i) {
        sum += w[i] * (x[i] - x_mean) * (y[i] - y_mean);
        squares += w[i] * w[i];
    }
    return sum / (1.0 - squares);
}

// Ensemble Kalman update: each member moves by its own simulated observation.
template <class Model>
void nudge(const Model& model, double d, const std::vector<double>& w, Noise& noise,
           Ensemble<Model>& ensemble) {
    const double* z = noise.row();
    const double sd = std::sqrt(model.gamma);
    std::vector<double> simulated(ensemble.N);
    for (int64_t i = 0; i < ensemble.N; ++i) simulated[i] = ensemble.x[0][i] + sd * z[i];
    const double variance = weighted_covariance(w, simulated, simulated);
    double gain[Model::n];
    for (int a = 0; a < Model::n; ++a)
        gain[a] = weighted_covariance(w, ensemble.x[a], simulated) / variance;
    for (int a = 0; a < Model::n; ++a)
        for (int64_t i = 0; i < ensemble.N; ++i)
            ensemble.x[a][i] += gain[a] * (d - simulated[i]);
}

// Log of the normal density of the observation given each member.
template <class Model>
void log_density(const Model& model, double d, const Ensemble<Model>& ensemble,
                 std::vector<double>& out) {
    const double constant = -0.5 * std::log(2.0 * M_PI * model.gamma);
    for (int64_t i = 0; i < ensemble.N; ++i) {
        const double residual = d - ensemble.x[0][i];
        out[i] = constant - 0.5 * residual * residual / model.gamma;
    }
}

// Exponentiate and normalise; returns the log of the sum.
inline double normalise(std::vector<double>& log_w, std::vector<double>& w) {
    double largest = log_w[0], sum = 0.0;
    for (double l : log_w) largest = l > largest ? l : largest;
    for (size_t i = 0; i < w.size(); ++i) sum += w[i] = std::exp(log_w[i] - largest);
    const double log_sum = largest + std::log(sum);
    for (size_t i = 0; i < w.size(); ++i) {
        w[i] /= sum;
        log_w[i] -= log_sum;
    }
    return log_sum;
}
