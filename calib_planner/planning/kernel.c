/* Copyright 2026 calib_planner contributors */
/* SPDX-License-Identifier: Apache-2.0 */
/* How configurations share the errors of their joints, without an array call per joint; see extended.py.
 *
 * With levers c (N, rows, joints), N = S·m configurations in S runs of m, and kernels κ (joints, S, m, m),
 *
 *     couple(levers, kernels, out):                   out_ij = Σ_l c_l(q_i) κ_l(i, j) c_l(q_j)ᵀ ,
 *     couple_back(levers, kernels, changes, weights, by_lever, by_joint):   for weights K = Kᵀ on V, with u = K_ij c_l(q_j),
 *                 by_lever(i, l) −= 2 Σ_j κ_l(i, j) u ,   by_joint(i, l) −= 2 Σ_j change_l(i, j) c_l(q_i) · u ,
 *
 * out and weights (S, m·rows, m·rows), changes (joints, S, m, m) the derivative of κ_l(i, j) by joint l of i, by_lever
 * (N, rows, joints), by_joint (N, joints). All arrays contiguous, float64; κ_l(i, j) = κ_l(j, i). Nothing is returned.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <string.h>

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__linux__)
#define VECTORISED __attribute__((target_clones("avx512f", "avx2", "default")))
#else
#define VECTORISED
#endif

#define MOST 64 /* joints */

typedef struct {
    Py_ssize_t runs, m, rows, joints;
} sizes;

VECTORISED static void add_up(sizes z, const double *levers, const double *kernels, double *out) {
    const Py_ssize_t m = z.m, R = z.rows, L = z.joints, width = m * R, plane = z.runs * m * m;
    double kappa[MOST];
    for (Py_ssize_t s = 0; s < z.runs; s++) {
        double *const block = out + s * width * width;
        for (Py_ssize_t i = 0; i < m; i++)
            for (Py_ssize_t j = 0; j <= i; j++) {
                const double *const left = levers + (s * m + i) * R * L, *const right = levers + (s * m + j) * R * L;
                for (Py_ssize_t l = 0; l < L; l++) kappa[l] = kernels[l * plane + (s * m + i) * m + j];
                for (Py_ssize_t a = 0; a < R; a++) {
                    double pushed[MOST];
                    for (Py_ssize_t l = 0; l < L; l++) pushed[l] = kappa[l] * left[a * L + l];
                    for (Py_ssize_t b = 0; b < R; b++) {
                        double sum = 0.0;
                        for (Py_ssize_t l = 0; l < L; l++) sum += pushed[l] * right[b * L + l];
                        block[(i * R + a) * width + j * R + b] = sum;
                        block[(j * R + b) * width + i * R + a] = sum;
                    }
                }
            }
    }
}

VECTORISED static void take_back(sizes z, const double *levers, const double *kernels, const double *changes,
                                 const double *weights, double *by_lever, double *by_joint) {
    const Py_ssize_t m = z.m, R = z.rows, L = z.joints, width = m * R, plane = z.runs * m * m;
    double u[MOST], push[MOST];
    for (Py_ssize_t i = 0; i < z.runs * m; i++) {
        const Py_ssize_t run = i / m;
        const double *const own = levers + i * R * L;
        for (Py_ssize_t j = 0; j < m; j++) {
            const double *const right = levers + (run * m + j) * R * L;
            memset(push, 0, L * sizeof(double));
            for (Py_ssize_t a = 0; a < R; a++) {
                const double *const row = weights + (run * width + i % m * R + a) * width + j * R;
                memset(u, 0, L * sizeof(double));
                for (Py_ssize_t b = 0; b < R; b++)
                    for (Py_ssize_t l = 0; l < L; l++) u[l] += row[b] * right[b * L + l];
                for (Py_ssize_t l = 0; l < L; l++) {
                    by_lever[(i * R + a) * L + l] -= 2.0 * kernels[l * plane + i * m + j] * u[l];
                    push[l] += own[a * L + l] * u[l];
                }
            }
            for (Py_ssize_t l = 0; l < L; l++) by_joint[i * L + l] -= 2.0 * changes[l * plane + i * m + j] * push[l];
        }
    }
}

/* The arrays if their shapes fit those of the first two, (N, rows, joints) and (joints, S, m, m). */
static int take(PyObject *const *arguments, Py_ssize_t given, int wanted, int written, Py_buffer *view, sizes *z) {
    const int dimensions[2][6] = {{3, 4, 3}, {3, 4, 4, 3, 3, 2}};
    int have = 0, right = given == wanted;
    for (; right && have < wanted; have++) {
        const int flags = have >= written ? PyBUF_CONTIG : PyBUF_CONTIG_RO;
        if (PyObject_GetBuffer(arguments[have], &view[have], flags) < 0) break;
        right = view[have].ndim == dimensions[wanted == 6][have] && view[have].itemsize == 8;
    }
    if (right && have == wanted) {
        const Py_ssize_t N = view[0].shape[0], R = view[0].shape[1], L = view[0].shape[2];
        const Py_ssize_t S = view[1].shape[1], m = view[1].shape[2];
        const Py_ssize_t kernel[4] = {L, S, m, m}, whole[3] = {S, m * R, m * R}, lever[3] = {N, R, L}, joint[2] = {N, L};
        const Py_ssize_t *small[3] = {lever, kernel, whole}, *large[6] = {lever, kernel, kernel, whole, lever, joint};
        right = N == S * m && L <= MOST;
        for (int k = 0; k < wanted; k++)
            for (int axis = 0; axis < view[k].ndim; axis++)
                right = right && view[k].shape[axis] == (wanted == 6 ? large : small)[k][axis];
        *z = (sizes){S, m, R, L};
        if (right) return 1;
    }
    if (!PyErr_Occurred()) PyErr_SetString(PyExc_ValueError, "the arrays do not fit each other, or are not float64");
    while (have--) PyBuffer_Release(&view[have]);
    return 0;
}

static PyObject *couple(PyObject *self, PyObject *const *arguments, Py_ssize_t count) {
    Py_buffer view[3];
    sizes z;
    (void)self;
    if (!take(arguments, count, 3, 2, view, &z)) return NULL;
    Py_BEGIN_ALLOW_THREADS
    add_up(z, view[0].buf, view[1].buf, view[2].buf);
    Py_END_ALLOW_THREADS
    for (int k = 0; k < 3; k++) PyBuffer_Release(&view[k]);
    Py_RETURN_NONE;
}

static PyObject *couple_back(PyObject *self, PyObject *const *arguments, Py_ssize_t count) {
    Py_buffer view[6];
    sizes z;
    (void)self;
    if (!take(arguments, count, 6, 4, view, &z)) return NULL;
    Py_BEGIN_ALLOW_THREADS
    take_back(z, view[0].buf, view[1].buf, view[2].buf, view[3].buf, view[4].buf, view[5].buf);
    Py_END_ALLOW_THREADS
    for (int k = 0; k < 6; k++) PyBuffer_Release(&view[k]);
    Py_RETURN_NONE;
}

static PyMethodDef methods[] = {
    {"couple", (PyCFunction)(void (*)(void))couple, METH_FASTCALL, "see kernel.c"},
    {"couple_back", (PyCFunction)(void (*)(void))couple_back, METH_FASTCALL, "see kernel.c"},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_kernel", "Coupling of extended.py, in C.", -1, methods};

PyMODINIT_FUNC PyInit__kernel(void) { return PyModule_Create(&module); }
