// The three filters on the two systems, for ctypes.
#include "ekf.hpp"
#include "enkf.hpp"
#include "models.hpp"
#include "pf_enkf.hpp"

#define FILTERS_OF(name, Model)                                                                   \
    double name##_ekf(const double* theta, const int64_t* steps, int64_t J, const double* d,      \
                      const double* u) {                                                          \
        return ekf(Model(theta), Record{steps, J, d, u});                                         \
    }                                                                                             \
    double name##_enkf(const double* theta, const int64_t* steps, int64_t J, const double* d,     \
                       const double* u, const double* normals, const double*, int64_t N) {        \
        return enkf(Model(theta), Record{steps, J, d, u}, normals, N);                            \
    }                                                                                             \
    double name##_pf_enkf(const double* theta, const int64_t* steps, int64_t J, const double* d,  \
                          const double* u, const double* normals, const double* uniforms,         \
                          int64_t N) {                                                            \
        return pf_enkf(Model(theta), Record{steps, J, d, u}, normals, uniforms, N);               \
    }

extern "C" {
FILTERS_OF(double_well, DoubleWell)
FILTERS_OF(mass_spring_damper, MassSpringDamper)
}
