/* Copyright 2026 calib_planner contributors */
/* SPDX-License-Identifier: Apache-2.0 */
/* The programs of kinematics.py, and the running sums of linearisation.py, without an array call per operation.
 *
 * A program is a list of additions, subtractions and products of vectors over configurations. NumPy runs each over a
 * block of configurations with a call of its own; here one call runs them all, over blocks that stay in the
 * first-level cache. The operations and their order are the same, but that a product that is needed once is taken
 * with the sum that needs it, which saves a way through the cache and changes no digit. Sines and cosines come from the polynomials of
 * Sun's fdlibm after a reduction by quarter turns in three parts, which compilers turn into vector instructions;
 * beyond LARGEST from the C library.
 *
 * run(code, amounts, q, out): code is Program.code (int32, the layout stands in unpack), amounts (elements,) the
 * amounts of the elements, q (joints, N) and out (rows, N) contiguous, all float64. Nothing is returned.
 *
 * pull_back(chain, columns, axes, joint_columns, joint_axes, weights, out): Linearisation.pull_back with the arrays
 * of that class; chain is Layout.code (int32), weights (N, 3 targets, P or more) and out (N, joints).
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define BLOCK 256
#define LARGEST 1e5

#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__linux__)
#define VECTORISED __attribute__((target_clones("avx512f", "avx2", "default")))
#define NO_OVERLAP _Pragma("GCC ivdep")
#else
#define VECTORISED
#define NO_OVERLAP
#endif

enum { MUL, ADD, SUB, ADD2, SUB2, ADD1, SUB1, TAKE1 };
enum { AMOUNT, COS, SIN, TIMES, PLUS, MINUS };

typedef struct {
    int32_t scalars, vectors, turns, joints, inputs, constants, copies, slots, rows, registers, scratch, nodes;
    const int32_t *scalar, *vector, *turn, *input, *constant, *copy, *reg;
} program;

static int unpack(const int32_t *code, Py_ssize_t size, program *p) {
    if (size < 12) return 0;
    memcpy(p, code, 12 * sizeof(int32_t));
    const int32_t *at = code + 12;
    p->scalar = at, at += 4 * p->scalars;      /* operation, a, b, node */
    p->vector = at, at += 6 * p->vectors;      /* operation, a, b, c, d, slot */
    p->turn = at, at += 4 * p->turns;          /* joint, node, slot of cosine, slot of sine */
    p->input = at, at += 2 * p->inputs;        /* slot, joint */
    p->constant = at, at += 2 * p->constants;  /* slot, node */
    p->copy = at, at += 3 * p->copies;         /* row, sign, slot */
    p->reg = at, at += 2 * p->registers;       /* slot, register */
    return at - code == size;
}

/* Whether an angle is too large for the reduction. */
VECTORISED static int waves(const double *restrict q, double shift, double *restrict c, double *restrict s, int n) {
    const double quarter = 0.63661977236758134308, magic = 6755399441055744.0;
    int far = 0;
    NO_OVERLAP
    for (int i = 0; i < n; i++) {
        const double x = q[i] + shift, turns = x * quarter + magic, k = turns - magic;
        far |= !(fabs(x) < LARGEST);
        const double r = ((x - k * 1.57079632673412561417e+00) - k * 6.07710050630396597660e-11) -
                         k * 2.02226624879595063154e-21;
        const double z = r * r, h = 0.5 * z, w = 1.0 - h;
        const double sine =
            r + r * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 + z * (-1.98412698298579493134e-04 +
            z * (2.75573137070700676789e-06 + z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
        const double cosine =
            w + (((1.0 - w) - h) + z * z * (4.16666666666666019037e-02 + z * (-1.38888888888741095749e-03 +
            z * (2.48015872894767294178e-05 + z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 -
            z * 1.13596475577881948265e-11))))));
        const int32_t quadrant = (int32_t)k;
        const double one = quadrant & 1 ? cosine : sine, other = quadrant & 1 ? sine : cosine;
        s[i] = quadrant & 2 ? -one : one;
        c[i] = (quadrant + 1) & 2 ? -other : other;
    }
    return far;
}

#define LOOP(EXPRESSION)         \
    NO_OVERLAP                   \
    for (int i = 0; i < n; i++)  \
        d[i] = EXPRESSION;       \
    break

VECTORISED static void operations(const program *p, double *const *restrict table, int n) {
    const int32_t *op = p->vector;
    for (int32_t k = 0; k < p->vectors; k++, op += 6) {
        const double *restrict a = table[op[1]], *restrict b = table[op[2]];
        const double *restrict e = table[op[3]], *restrict f = table[op[4]];
        double *restrict d = table[op[5]];
        switch (op[0]) {
            case MUL: LOOP(a[i] * b[i]);
            case ADD: LOOP(a[i] + b[i]);
            case SUB: LOOP(a[i] - b[i]);
            case ADD2: LOOP(a[i] * b[i] + e[i] * f[i]);
            case SUB2: LOOP(a[i] * b[i] - e[i] * f[i]);
            case ADD1: LOOP(a[i] * b[i] + e[i]);
            case SUB1: LOOP(a[i] * b[i] - e[i]);
            case TAKE1: LOOP(e[i] - a[i] * b[i]);
        }
    }
}

static void evaluate(const program *p, const double *amounts, const double *q, double *out, Py_ssize_t count,
                     double *memory, double **table) {
    double *node = memory, *scratch = node + p->nodes, *wave = scratch + (Py_ssize_t)BLOCK * p->scratch;
    double *number = wave + 2 * (Py_ssize_t)BLOCK * p->turns;
    node[0] = 1.0;
    for (int32_t k = 0; k < p->scalars; k++) {
        const int32_t *s = p->scalar + 4 * k;
        double *to = node + s[3];
        switch (s[0]) {
            case AMOUNT: *to = amounts[s[1]]; break;
            case COS: *to = cos(node[s[1]]); break;
            case SIN: *to = sin(node[s[1]]); break;
            case TIMES: *to = node[s[1]] * node[s[2]]; break;
            case PLUS: *to = node[s[1]] + node[s[2]]; break;
            default: *to = node[s[1]] - node[s[2]];
        }
    }
    for (int32_t k = 0; k < p->constants; k++) {
        double *const to = table[p->constant[2 * k]] = number + (Py_ssize_t)BLOCK * k;
        for (Py_ssize_t i = 0; i < BLOCK && i < count; i++) to[i] = node[p->constant[2 * k + 1]];
    }
    for (int32_t k = 0; k < p->registers; k++)
        table[p->reg[2 * k]] = scratch + (Py_ssize_t)BLOCK * p->reg[2 * k + 1];
    for (int32_t k = 0; k < p->turns; k++) {
        table[p->turn[4 * k + 2]] = wave + 2 * (Py_ssize_t)BLOCK * k;
        table[p->turn[4 * k + 3]] = wave + 2 * (Py_ssize_t)BLOCK * k + BLOCK;
    }
    for (Py_ssize_t start = 0; start < count; start += BLOCK) {
        const int n = (int)(count - start < BLOCK ? count - start : BLOCK);
        for (int32_t row = 0; row < p->rows; row++) table[row] = out + row * count + start;
        for (int32_t k = 0; k < p->inputs; k++)
            table[p->input[2 * k]] = (double *)q + p->input[2 * k + 1] * count + start;
        for (int32_t k = 0; k < p->turns; k++) {
            const int32_t *t = p->turn + 4 * k;
            const double *from = q + t[0] * count + start, shift = t[1] ? node[t[1]] : 0.0;
            if (!waves(from, shift, table[t[2]], table[t[3]], n)) continue;
            for (int i = 0; i < n; i++) {
                table[t[2]][i] = cos(from[i] + shift);
                table[t[3]][i] = sin(from[i] + shift);
            }
        }
        operations(p, table, n);
        for (int32_t k = 0; k < p->copies; k++) {
            const int32_t *c = p->copy + 3 * k, sign = c[1];
            double *restrict to = table[c[0]];
            const double *restrict source = table[c[2]];
            if (sign == 0)
                memset(to, 0, n * sizeof(double));
            else if (sign > 0)
                memcpy(to, source, n * sizeof(double));
            else
                for (int i = 0; i < n; i++) to[i] = -source[i];
        }
    }
}

static PyObject *run(PyObject *self, PyObject *const *arguments, Py_ssize_t count) {
    Py_buffer view[4];
    int have = 0;
    PyObject *result = NULL;
    (void)self;
    if (count != 4) {
        PyErr_SetString(PyExc_TypeError, "run(code, amounts, q, out)");
        return NULL;
    }
    for (; have < 4; have++) {
        const int flags = have == 3 ? PyBUF_CONTIG : PyBUF_CONTIG_RO;
        if (PyObject_GetBuffer(arguments[have], &view[have], flags) < 0) goto done;
    }
    program p;
    const Py_ssize_t words = view[0].len / (Py_ssize_t)sizeof(int32_t);
    if (view[0].itemsize != 4 || !unpack(view[0].buf, words, &p) || view[1].itemsize != 8 ||
        view[2].itemsize != 8 || view[3].itemsize != 8) {
        PyErr_SetString(PyExc_ValueError, "code is int32, the other arrays float64");
        goto done;
    }
    const Py_ssize_t configurations = view[3].len / 8 / (p.rows ? p.rows : 1);
    if (view[2].len < 8 * configurations * p.joints || view[3].len != 8 * configurations * p.rows) {
        PyErr_SetString(PyExc_ValueError, "q is (joints, N) and out (rows, N)");
        goto done;
    }
    const size_t numbers = (size_t)p.nodes + (size_t)BLOCK * (p.scratch + 2 * p.turns + p.constants);
    double *memory = PyMem_RawMalloc(numbers * sizeof(double));
    double **table = PyMem_RawCalloc((size_t)p.slots + 1, sizeof(double *));
    if (!memory || !table) {
        PyErr_NoMemory();
    } else {
        Py_BEGIN_ALLOW_THREADS
        evaluate(&p, view[1].buf, view[2].buf, view[3].buf, configurations, memory, table);
        Py_END_ALLOW_THREADS
        result = Py_NewRef(Py_None);
    }
    PyMem_RawFree(memory);
    PyMem_RawFree(table);
done:
    while (have--) PyBuffer_Release(&view[have]);
    return result;
}

/* ── running sums ──────────────────────────────────────────────────────────────────────────────────── */

#define RUN 32 /* configurations side by side */

typedef struct {
    Py_ssize_t count, parameters, targets, joints, stride;
    const int32_t *order, *rotates, *before, *turns; /* parameters in chain order; see Layout.code */
    const double *columns, *axes, *joint_columns, *joint_axes, *weights;
} chain;

static inline void cross_add(double *restrict to, const double *restrict u, Py_ssize_t du, const double *restrict v,
                      Py_ssize_t dv, int n) {
    const double *ux = u, *uy = u + du, *uz = u + 2 * du, *vx = v, *vy = v + dv, *vz = v + 2 * dv;
    double *restrict x = to, *restrict y = to + RUN, *restrict z = to + 2 * RUN;
    NO_OVERLAP
    for (int i = 0; i < n; i++) {
        x[i] += uy[i] * vz[i] - uz[i] * vy[i];
        y[i] += uz[i] * vx[i] - ux[i] * vz[i];
        z[i] += ux[i] * vy[i] - uy[i] * vx[i];
    }
}

static inline void dot_add(double *restrict to, const double *restrict u, Py_ssize_t du, const double *restrict v, int n) {
    NO_OVERLAP
    for (int i = 0; i < n; i++) to[i] += u[i] * v[i] + u[i + du] * v[i + RUN] + u[i + 2 * du] * v[i + 2 * RUN];
}

/* Weights of one parameter and target of n configurations, (3, RUN). */
static inline void gather(const chain *c, Py_ssize_t first, int n, Py_ssize_t target, Py_ssize_t parameter, double *to) {
    const double *from = c->weights + (first * c->targets + target) * 3 * c->stride + parameter;
    for (int i = 0; i < n; i++, from += 3 * c->targets * c->stride) {
        to[i] = from[0];
        to[i + RUN] = from[c->stride];
        to[i + 2 * RUN] = from[2 * c->stride];
    }
}

VECTORISED static void sum_back(const chain *c, double *restrict sums, double *restrict gradient, double *out) {
    const Py_ssize_t N = c->count, T = c->targets, P = c->parameters, L = c->joints;
    double weight[3 * RUN];
    for (Py_ssize_t first = 0; first < N; first += RUN) {
        const int n = (int)(N - first < RUN ? N - first : RUN);
        memset(gradient, 0, L * RUN * sizeof(double));
        memset(sums, 0, 3 * RUN * sizeof(double)); /* of J_a × G_a, from the tip */
        for (Py_ssize_t i = P; i >= 0; i--) {
            for (Py_ssize_t k = 0; k < L; k++)
                if (c->before[k] == i && c->turns[k])
                    dot_add(gradient + k * RUN, c->joint_axes + 3 * k * N + first, N, sums, n);
            for (Py_ssize_t t = 0; i && t < T; t++) {
                gather(c, first, n, t, c->order[i - 1], weight);
                cross_add(sums, c->columns + (c->order[i - 1] * T + t) * 3 * N + first, N, weight, RUN, n);
            }
        }
        memset(sums, 0, 3 * T * RUN * sizeof(double)); /* of G_a × w_a per target, from the base */
        for (Py_ssize_t i = 0; i <= P; i++) {
            for (Py_ssize_t k = 0; k < L; k++)
                for (Py_ssize_t t = 0; c->before[k] == i && t < T; t++)
                    dot_add(gradient + k * RUN, c->joint_columns + (k * T + t) * 3 * N + first, N, sums + 3 * t * RUN, n);
            for (Py_ssize_t t = 0; i < P && c->rotates[i] && t < T; t++) {
                gather(c, first, n, t, c->order[i], weight);
                cross_add(sums + 3 * t * RUN, weight, RUN, c->axes + 3 * c->order[i] * N + first, N, n);
            }
        }
        for (int i = 0; i < n; i++)
            for (Py_ssize_t k = 0; k < L; k++) out[(first + i) * L + k] = gradient[k * RUN + i];
    }
}

static PyObject *pull_back(PyObject *self, PyObject *const *arguments, Py_ssize_t count) {
    Py_buffer view[7];
    const int dimensions[7] = {1, 4, 3, 4, 3, 3, 2};
    int have = 0, right = 1;
    PyObject *result = NULL;
    (void)self;
    if (count != 7) {
        PyErr_SetString(PyExc_TypeError, "pull_back(chain, columns, axes, joint_columns, joint_axes, weights, out)");
        return NULL;
    }
    for (; have < 7; have++) {
        const int flags = have == 6 ? PyBUF_CONTIG : PyBUF_CONTIG_RO;
        if (PyObject_GetBuffer(arguments[have], &view[have], flags) < 0) goto done;
        right = right && view[have].ndim == dimensions[have] && view[have].itemsize == (have ? 8 : 4);
    }
    if (right) {
        const Py_ssize_t P = view[1].shape[0], T = view[1].shape[1], N = view[1].shape[3], L = view[3].shape[0];
        const Py_ssize_t wanted[7][4] = {{2 * P + 2 * L}, {P, T, 3, N}, {P, 3, N}, {L, T, 3, N}, {L, 3, N},
                                         {N, 3 * T, view[5].shape[2]}, {N, L}};
        for (int k = 0; k < 7; k++)
            for (int axis = 0; axis < dimensions[k]; axis++)
                right = right && view[k].shape[axis] == wanted[k][axis];
        const int32_t *code = view[0].buf;
        for (Py_ssize_t a = 0; right && a < P; a++) right = code[a] >= 0 && code[a] < P && code[a] < view[5].shape[2];
        if (right) {
            const chain c = {N, P, T, L, view[5].shape[2], code, code + P, code + 2 * P, code + 2 * P + L,
                             view[1].buf, view[2].buf, view[3].buf, view[4].buf, view[5].buf};
            double *memory = PyMem_RawMalloc((size_t)(3 * (T + 1) + L) * RUN * sizeof(double));
            if (!memory) {
                PyErr_NoMemory();
                goto done;
            }
            Py_BEGIN_ALLOW_THREADS
            sum_back(&c, memory, memory + 3 * (T + 1) * RUN, view[6].buf);
            Py_END_ALLOW_THREADS
            PyMem_RawFree(memory);
            result = Py_NewRef(Py_None);
        }
    }
    if (!right) PyErr_SetString(PyExc_ValueError, "the shapes do not fit each other, or are not of float64");
done:
    while (have--) PyBuffer_Release(&view[have]);
    return result;
}

static PyMethodDef methods[] = {
    {"pull_back", (PyCFunction)(void (*)(void))pull_back, METH_FASTCALL, "see kernel.c"},
    {"run", (PyCFunction)(void (*)(void))run, METH_FASTCALL, "run(code, amounts, q, out): see kernel.c"},
    {NULL, NULL, 0, NULL},
};
static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "_kernel", "Programs of kinematics.py, in C.", -1, methods};

PyMODINIT_FUNC PyInit__kernel(void) { return PyModule_Create(&module); }
