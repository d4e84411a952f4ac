// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* The Python module cube_tensor_driver._scan: cube_scan.h for cube_tensor_driver/core/kernel,
 * and cube_contact.h for cube_tensor_driver/touch.
 *
 * Plain C API of Python, limited to the stable ABI of 3.10. Arrays of numpy come by their attribute
 * __array_struct__ (numpy, "The array interface protocol"), so that no header of numpy is needed. */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030A0000
#include <Python.h>

#include "cube_contact.h"
#include "cube_scan.h"

typedef struct {
    int two, n_axes;
    char kind;
    int size, flags;
    Py_ssize_t *shape, *strides;
    void *data;
    PyObject *descr;
} array_interface;

/* Flags: contiguous, aligned, in the byte order of the machine; and writeable. */
enum { READABLE = 0x1 | 0x100 | 0x200, WRITEABLE = 0x400 };

static PyObject *attribute; /* the text "__array_struct__", whose hash is computed once */

/* Stores one array in the call. false: it does not fit. */
static bool store(
    const cube_scan_array *wanted, void *call, int64_t *length, const array_interface *array) {
    const bool is_written = wanted->use == CUBE_SCAN_STATE || wanted->use == CUBE_SCAN_RESULT;
    const int flags = READABLE | (is_written ? WRITEABLE : 0);
    int64_t shape[4];
    if ((array->flags & flags) != flags || array->kind != wanted->kind ||
        (size_t)array->size != wanted->size || array->n_axes > 4)
        return false;
    for (int axis = 0; axis < array->n_axes; axis++)
        shape[axis] = array->shape[axis];
    return cube_scan_set(wanted, call, length, array->data, shape, (size_t)array->n_axes);
}

/* Stores the arguments from `first` on in the call. The tuple of arguments holds the arrays, so that
 * their memory outlives the capsules. If one does not fit, an exception is set. */
static void store_all(
    PyObject *args, Py_ssize_t first, const cube_scan_array *arrays, size_t n_arrays, void *call,
    int64_t *length) {
    if (PyTuple_Size(args) != first + (Py_ssize_t)n_arrays)
        PyErr_Format(PyExc_TypeError, "it takes %zd arguments", first + (Py_ssize_t)n_arrays);
    for (size_t i = 0; i < n_arrays && !PyErr_Occurred(); i++) {
        PyObject *object = PyTuple_GetItem(args, first + (Py_ssize_t)i);
        const enum cube_scan_use use = arrays[i].use;
        if (object == Py_None && (use == CUBE_SCAN_STATE || use == CUBE_SCAN_OPTION))
            continue;
        PyObject *capsule = PyObject_GetAttr(object, attribute);
        const array_interface *array = capsule == NULL ? NULL : PyCapsule_GetPointer(capsule, NULL);
        if (array != NULL && !store(&arrays[i], call, length, array))
            PyErr_Format(PyExc_ValueError, "array %s does not fit", arrays[i].name);
        Py_XDECREF(capsule);
    }
}

static PyObject *run(PyObject *module, PyObject *args) {
    (void)module;
    cube_scan_call call = cube_scan_begin();
    int64_t request, row = 0;
    store_all(args, 2, cube_scan_arrays, CUBE_SCAN_N_ARRAYS, &call, call.length);
    if (!PyErr_Occurred()) {
        row = PyLong_AsLongLong(PyTuple_GetItem(args, 0));
        call.n_residuals = PyLong_AsLongLong(PyTuple_GetItem(args, 1));
    }
    if (!PyErr_Occurred() && (row = cube_scan(&call, row, &request)) < 0)
        PyErr_SetString(PyExc_ValueError, "the arrays do not fit together");
    return PyErr_Occurred() ? NULL : Py_BuildValue("LL", (long long)row, (long long)request);
}

static PyObject *forces(PyObject *module, PyObject *args) {
    (void)module;
    cube_forces_call call = cube_forces_begin();
    store_all(args, 0, cube_forces_arrays, CUBE_FORCES_N_ARRAYS, &call, call.length);
    if (PyErr_Occurred())
        return NULL;
    cube_forces(&call);
    return Py_NewRef(Py_None);
}

static PyObject *filter(PyObject *module, PyObject *args) {
    (void)module;
    cube_filter_call call = cube_filter_begin();
    store_all(args, 0, cube_filter_arrays, CUBE_FILTER_N_ARRAYS, &call, call.length);
    if (PyErr_Occurred())
        return NULL;
    cube_filter(&call);
    return Py_NewRef(Py_None);
}

static PyObject *respond(PyObject *module, PyObject *args) {
    (void)module;
    cube_contact_call call = cube_contact_begin();
    store_all(args, 0, cube_contact_arrays, CUBE_RESPOND_N_ARRAYS, &call, call.length);
    if (!PyErr_Occurred() && !cube_respond(&call))
        PyErr_SetString(PyExc_ValueError, "the arrays do not fit together");
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

static PyObject *linearise(PyObject *module, PyObject *args) {
    (void)module;
    cube_contact_call call = cube_contact_begin();
    store_all(args, 1, cube_contact_arrays, CUBE_CONTACT_N_ARRAYS, &call, call.length);
    const double factor = PyErr_Occurred() ? 0 : PyFloat_AsDouble(PyTuple_GetItem(args, 0));
    if (!PyErr_Occurred() && !cube_linearise(&call, factor))
        PyErr_SetString(PyExc_ValueError, "the arrays do not fit together");
    return PyErr_Occurred() ? NULL : Py_NewRef(Py_None);
}

static PyMethodDef functions[] = {
    {"run", run, METH_VARARGS, NULL},
    {"forces", forces, METH_VARARGS, NULL},
    {"filter", filter, METH_VARARGS, NULL},
    {"respond", respond, METH_VARARGS, NULL},
    {"linearise", linearise, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, .m_name = "_scan", .m_size = -1, .m_methods = functions};

PyMODINIT_FUNC PyInit__scan(void) {
    attribute = PyUnicode_InternFromString("__array_struct__");
    return attribute == NULL ? NULL : PyModule_Create(&module);
}
