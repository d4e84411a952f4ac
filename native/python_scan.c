/* The Python module cube_tensor_driver._scan: cube_scan.h for cube_tensor_driver/core/kernel.
 *
 * Plain C API of Python, limited to the stable ABI of 3.10. Arrays of numpy come by their attribute
 * __array_struct__, so that no header of numpy is needed. */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030A0000
#include <Python.h>

#include "cube_scan.h"

#include <string.h>

/* PyArrayInterface of numpy ("The array interface protocol", C-struct access), version 3. */
typedef struct {
    int two, n_axes;
    char kind;
    int size, flags;
    Py_ssize_t *shape, *strides;
    void *data;
    PyObject *descr;
} array_interface;

#define C_CONTIGUOUS 0x1
#define ALIGNED 0x100
#define NATIVE_ORDER 0x200
#define WRITEABLE 0x400

/* Checks one array, and stores its address and its lengths in the call. false: it does not fit. */
static bool store_array(
    const array_interface *array, const cube_scan_array *wanted, cube_scan_call *call) {
    const int needed = C_CONTIGUOUS | ALIGNED | NATIVE_ORDER | (wanted->is_result ? WRITEABLE : 0);
    const bool is_real = wanted->kind == 'R';
    const size_t real = call->is_double ? sizeof(double) : sizeof(float);
    if (array->two != 2 || (array->flags & needed) != needed ||
        array->kind != (is_real ? 'f' : wanted->kind) ||
        (size_t)array->size != (is_real ? real : wanted->size) ||
        (size_t)array->n_axes != strlen(wanted->shape))
        return false;
    for (int axis = 0; axis < array->n_axes; axis++) {
        const char letter = wanted->shape[axis];
        int64_t fixed = letter - '0';
        int64_t *length = cube_scan_length(call, letter);
        if (length == NULL)
            length = &fixed;
        else if (*length < 0)
            *length = array->shape[axis];
        if (*length != array->shape[axis])
            return false;
    }
    memcpy((char *)call + wanted->offset, &array->data, sizeof array->data);
    return true;
}

static PyObject *run(PyObject *module, PyObject *args) {
    (void)module;
    const Py_ssize_t n_arrays = (Py_ssize_t)cube_scan_n_arrays;
    if (PyTuple_Size(args) != n_arrays + 3) {
        PyErr_Format(PyExc_TypeError, "run takes %zd arguments", n_arrays + 3);
        return NULL;
    }
    const long long start = PyLong_AsLongLong(PyTuple_GetItem(args, 0));
    cube_scan_call call;
    cube_scan_begin(&call);
    call.n_residuals = PyLong_AsLongLong(PyTuple_GetItem(args, 1));
    call.is_double = PyObject_IsTrue(PyTuple_GetItem(args, 2)) == 1;
    if (PyErr_Occurred())
        return NULL;
    for (Py_ssize_t i = 0; i < n_arrays; i++) {
        const cube_scan_array *wanted = &cube_scan_arrays[i];
        PyObject *object = PyTuple_GetItem(args, i + 3);
        if (object == Py_None && wanted->may_be_none)
            continue;
        PyObject *capsule = PyObject_GetAttrString(object, "__array_struct__");
        if (capsule == NULL)
            return NULL;
        const array_interface *array = PyCapsule_GetPointer(capsule, NULL);
        /* The tuple of arguments holds the array, so that its memory outlives the capsule. */
        const bool fits = array != NULL && store_array(array, wanted, &call);
        Py_DECREF(capsule);
        if (PyErr_Occurred())
            return NULL;
        if (!fits) {
            PyErr_Format(PyExc_ValueError, "array %s has another type or shape", wanted->name);
            return NULL;
        }
    }
    if (!cube_scan_fits(&call, start)) {
        PyErr_SetString(PyExc_ValueError, "the lengths or arrays of a call do not fit together");
        return NULL;
    }
    int64_t request;
    const int64_t row = cube_scan(&call, start, &request);
    return Py_BuildValue("LL", (long long)row, (long long)request);
}

static PyMethodDef functions[] = {{"run", run, METH_VARARGS, NULL}, {NULL, NULL, 0, NULL}};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, .m_name = "_scan", .m_size = -1, .m_methods = functions};

PyMODINIT_FUNC PyInit__scan(void) { return PyModule_Create(&module); }
