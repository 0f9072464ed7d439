/* Copyright 2026 calib_planner contributors */
/* SPDX-License-Identifier: Apache-2.0 */
/* What planning does with many small numbers, without an array call for each step.
 *
 * How configurations share the errors of their joints; see extended.py.
 *
 * With levers c (N, rows, joints), N = S·m configurations in S runs of m, and kernels κ (joints, S, m, m),
 *
 *     couple(levers, kernels, out):                   out_ij = Σ_l c_l(q_i) κ_l(i, j) c_l(q_j)ᵀ ,
 *     couple_back(levers, kernels, changes, weights, by_lever, by_joint):   for weights K = Kᵀ on V, with u = K_ij c_l(q_j),
 *                 by_lever(i, l) −= 2 Σ_j κ_l(i, j) u ,   by_joint(i, l) −= 2 Σ_j change_l(i, j) c_l(q_i) · u ,
 *
 * out and weights (S, m·rows, m·rows), changes (joints, S, m, m) the derivative of κ_l(i, j) by joint l of i, by_lever
 * (N, rows, joints), by_joint (N, joints); κ_l(i, j) = κ_l(j, i).
 *
 *     bend(forms, out):     the largest second difference of N boxes (N, s_1, …, s_k) along each axis, out (N, k); see
 *                           certify/branch_and_bound.py,
 *     turn(inverse, step, scaled, weighted):     inverse (rows, D, D) ← inverse − u sᵀ − s uᵀ + w sᵀ, with s, u and w
 *                           the other arguments, (rows, D) each; see search/descent.py.
 *
 * These two give what NumPy gives to the last digit. All arrays contiguous, float64. Nothing is returned.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
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

#define MOST_AXES 16

/* Four running maxima: one would wait for itself. */
VECTORISED static double largest_bend(const double *low, Py_ssize_t after) {
    double most[4] = {0.0, 0.0, 0.0, 0.0};
    for (Py_ssize_t a = 0; a < after; a++) {
        const double second = fabs(low[2 * after + a] - 2.0 * low[after + a] + low[a]);
        most[a & 3] = second > most[a & 3] ? second : most[a & 3];
    }
    for (int k = 1; k < 4; k++) most[0] = most[k] > most[0] ? most[k] : most[0];
    return most[0];
}

static void bends(const double *forms, Py_ssize_t boxes, int axes, const Py_ssize_t *shape, double *out) {
    Py_ssize_t whole = 1;
    for (int k = 0; k < axes; k++) whole *= shape[k];
    for (Py_ssize_t n = 0; n < boxes; n++) {
        const double *const form = forms + n * whole;
        for (Py_ssize_t k = 0, after = whole; k < axes; k++) {
            const Py_ssize_t run = after; /* coefficients of this axis and of those behind it */
            after /= shape[k];
            double most = 0.0;
            for (Py_ssize_t first = 0; first < whole; first += run)
                for (Py_ssize_t i = 0; i + 2 < shape[k]; i++) {
                    const double bend = largest_bend(form + first + i * after, after);
                    most = bend > most ? bend : most;
                }
            out[n * axes + k] = most;
        }
    }
}

VECTORISED static void turn_one(Py_ssize_t D, double *h, const double *s, const double *u, const double *w) {
    for (Py_ssize_t i = 0; i < D; i++)
        for (Py_ssize_t j = 0; j < D; j++) h[i * D + j] = h[i * D + j] - u[i] * s[j] - u[j] * s[i] + w[i] * s[j];
}

/* The arrays, of which those from ``written`` on may be written to; their number, or 0 with an error. */
static int buffers(PyObject *const *arguments, Py_ssize_t given, int wanted, unsigned written, Py_buffer *view) {
    int have = 0;
    for (; given == wanted && have < wanted; have++)
        if (PyObject_GetBuffer(arguments[have], &view[have], written >> have & 1 ? PyBUF_CONTIG : PyBUF_CONTIG_RO) < 0 ||
            view[have].itemsize != 8)
            break;
    if (have == wanted) return 1;
    if (PyErr_Occurred() == NULL) {
        PyErr_SetString(PyExc_ValueError, "the arrays do not fit each other, or are not float64");
        have += given == wanted;
    }
    while (have--) PyBuffer_Release(&view[have]);
    return 0;
}

static PyObject *released(Py_buffer *view, int count, int right) {
    for (int k = 0; k < count; k++) PyBuffer_Release(&view[k]);
    if (right) Py_RETURN_NONE;
    PyErr_SetString(PyExc_ValueError, "the arrays do not fit each other, or are not float64");
    return NULL;
}

static PyObject *bend(PyObject *self, PyObject *const *arguments, Py_ssize_t count) {
    Py_buffer view[2];
    (void)self;
    if (!buffers(arguments, count, 2, 2u, view)) return NULL;
    const int axes = view[0].ndim - 1;
    const int right = axes >= 1 && axes <= MOST_AXES && view[1].ndim == 2 && view[1].shape[0] == view[0].shape[0] &&
                      view[1].shape[1] == axes && view[0].len > 0;
    if (right) {
        Py_BEGIN_ALLOW_THREADS
        bends(view[0].buf, view[0].shape[0], axes, view[0].shape + 1, view[1].buf);
        Py_END_ALLOW_THREADS
    }
    return released(view, 2, right);
}

static PyObject *turn(PyObject *self, PyObject *const *arguments, Py_ssize_t count) {
    Py_buffer view[4];
    (void)self;
    if (!buffers(arguments, count, 4, 1u, view)) return NULL;
    const Py_ssize_t rows = view[0].ndim == 3 ? view[0].shape[0] : -1, D = view[0].ndim == 3 ? view[0].shape[1] : -1;
    int right = rows >= 0 && view[0].shape[2] == D;
    for (int k = 1; k < 4; k++) right = right && view[k].ndim == 2 && view[k].shape[0] == rows && view[k].shape[1] == D;
    if (right) {
        double *const h = view[0].buf;
        const double *const s = view[1].buf, *const u = view[2].buf, *const w = view[3].buf;
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t n = 0; n < rows; n++) turn_one(D, h + n * D * D, s + n * D, u + n * D, w + n * D);
        Py_END_ALLOW_THREADS
    }
    return released(view, 4, right);
}

static PyMethodDef methods[] = {
    {"bend", (PyCFunction)(void (*)(void))bend, METH_FASTCALL, "see kernel.c"},
    {"turn", (PyCFunction)(void (*)(void))turn, METH_FASTCALL, "see kernel.c"},
    {"couple", (PyCFunction)(void (*)(void))couple, METH_FASTCALL, "see kernel.c"},
    {"couple_back", (PyCFunction)(void (*)(void))couple_back, METH_FASTCALL, "see kernel.c"},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_kernel", "Inner loops of planning, in C.", -1, methods};

PyMODINIT_FUNC PyInit__kernel(void) { return PyModule_Create(&module); }
