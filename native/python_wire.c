/* The Python module cube_tensor_driver._wire: cube_wire.h for cube_tensor_driver/device/wire/native.py.
 *
 * Plain C API of Python, limited to the stable ABI of 3.10: one build serves all later versions.
 * The functions and their contracts for Python stand in cube_tensor_driver/_wire.pyi. What makes no
 * Python object runs without the interpreter's lock. */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030A0000
#include <Python.h>

#include "cube_wire.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define READ_CHUNK 65536

/* ------------------------------------------------------------------------------ Decoder ------- */

/* counters, other_version: of the decoder after the last call, for other threads to read.
 * is_busy: a call works on it without the interpreter's lock.
 * input: what was read and is not decoded yet.
 * frames: the decoded frames of one call, each behind its length as uint32_t. */
typedef struct {
    PyObject_HEAD
    cube_decoder decoder;
    cube_counters counters;
    int other_version;
    bool is_busy;
    uint8_t buffer[CUBE_DECODER_SIZE(CUBE_MAX_PAYLOAD)];
    uint8_t input[READ_CHUNK];
    uint8_t *frames;
    size_t used, room;
} Decoder;

static PyTypeObject *decoder_type;

static PyObject *decoder_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    (void)keywords;
    if (!PyArg_ParseTuple(args, ":Decoder"))
        return NULL;
    allocfunc allocate = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    Decoder *self = (Decoder *)allocate(type, 0);
    if (self != NULL) {
        cube_decoder_init(&self->decoder, self->buffer, sizeof self->buffer);
        self->other_version = self->decoder.other_version;
    }
    return (PyObject *)self;
}

static void decoder_dealloc(PyObject *object) {
    PyTypeObject *type = Py_TYPE(object);
    free(((Decoder *)object)->frames);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    release(object);
    Py_DECREF(type);
}

/* Decodes bytes and adds their frames to `frames`, without the lock. false: out of memory. */
static bool decode(Decoder *self, const uint8_t *data, size_t size) {
    /* A frame and its length are shorter than twice the code, and one may have begun before. */
    size_t most = self->used + 2 * size + CUBE_MAX_RUN;
    if (most > self->room) {
        uint8_t *grown = realloc(self->frames, most);
        if (grown == NULL)
            return false;
        self->frames = grown;
        self->room = most;
    }
    while (size > 0) {
        cube_frame frame;
        size_t taken = cube_decode(&self->decoder, data, size, &frame);
        data += taken;
        size -= taken;
        if (frame.type != CUBE_NO_FRAME) {
            uint32_t length = (uint32_t)frame.size;
            memcpy(self->frames + self->used, &length, sizeof length);
            memcpy(self->frames + self->used + sizeof length, frame.raw, frame.size);
            self->used += sizeof length + frame.size;
        }
    }
    return true;
}

/* Publishes the counters of the decoder; needs the lock. */
static void publish_counters(Decoder *self) {
    self->counters = self->decoder.counters;
    self->other_version = self->decoder.other_version;
}

/* Returns the frames as a list of bytes, and removes them from the decoder. */
static PyObject *take_frames(Decoder *self) {
    publish_counters(self);
    PyObject *list = PyList_New(0);
    for (size_t at = 0; list != NULL && at < self->used;) {
        uint32_t length;
        memcpy(&length, self->frames + at, sizeof length);
        at += sizeof length;
        PyObject *raw = PyBytes_FromStringAndSize((const char *)self->frames + at, length);
        at += length;
        if (raw == NULL || PyList_Append(list, raw) < 0)
            Py_CLEAR(list);
        Py_XDECREF(raw);
    }
    self->used = 0;
    return list;
}

/* Gets the bytes of a bytes or bytearray object. false: it is neither, and an exception is set. */
static bool get_bytes(PyObject *object, const uint8_t **data, size_t *size) {
    if (PyByteArray_Check(object)) {
        *data = (const uint8_t *)PyByteArray_AsString(object);
        *size = (size_t)PyByteArray_Size(object);
        return true;
    }
    char *bytes;
    Py_ssize_t length;
    if (PyBytes_AsStringAndSize(object, &bytes, &length) < 0)
        return false;
    *data = (const uint8_t *)bytes;
    *size = (size_t)length;
    return true;
}

/* Returns whether no other thread reads this link now. false: an exception is set. */
static bool is_free(const Decoder *self) {
    if (self->is_busy)
        PyErr_SetString(PyExc_RuntimeError, "a call of read_links has this decoder");
    return !self->is_busy;
}

static PyObject *decoder_feed(PyObject *object, PyObject *argument) {
    Decoder *self = (Decoder *)object;
    const uint8_t *data;
    size_t size;
    if (!is_free(self) || !get_bytes(argument, &data, &size))
        return NULL;
    /* The lock is kept, because another thread might resize a bytearray. */
    if (!decode(self, data, size))
        return PyErr_NoMemory();
    return take_frames(self);
}

static PyObject *decoder_reset(PyObject *object, PyObject *nothing) {
    (void)nothing;
    Decoder *self = (Decoder *)object;
    if (!is_free(self))
        return NULL;
    cube_decoder_reset(&self->decoder);
    publish_counters(self);
    Py_RETURN_NONE;
}

static PyObject *decoder_counters(PyObject *object, PyObject *nothing) {
    (void)nothing;
    const cube_counters *c = &((Decoder *)object)->counters;
    return Py_BuildValue(
        "(KKKKKKKK)", c->bytes, c->frames, c->crc, c->framing, c->length, c->version,
        c->unknown_type, c->overrun);
}

static PyObject *decoder_other_version(PyObject *object, PyObject *nothing) {
    (void)nothing;
    int version = ((Decoder *)object)->other_version;
    if (version < 0)
        Py_RETURN_NONE;
    return PyLong_FromLong(version);
}

static PyMethodDef decoder_methods[] = {
    {"feed", decoder_feed, METH_O, NULL},
    {"reset", decoder_reset, METH_NOARGS, NULL},
    {"counters", decoder_counters, METH_NOARGS, NULL},
    {"other_version", decoder_other_version, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot decoder_slots[] = {
    {Py_tp_new, decoder_new},
    {Py_tp_dealloc, decoder_dealloc},
    {Py_tp_methods, decoder_methods},
    {0, NULL},
};

static PyType_Spec decoder_spec = {
    .name = "cube_tensor_driver._wire.Decoder",
    .basicsize = sizeof(Decoder),
    .flags = Py_TPFLAGS_DEFAULT,
    .slots = decoder_slots,
};

/* ------------------------------------------------------------------------------ functions ----- */

static PyObject *cobs_encode(PyObject *module, PyObject *argument) {
    (void)module;
    const uint8_t *data;
    size_t size;
    if (!get_bytes(argument, &data, &size))
        return NULL;
    uint8_t *out = PyMem_Malloc(CUBE_COBS_SIZE(size));
    if (out == NULL)
        return PyErr_NoMemory();
    size_t length = cube_cobs_encode(data, size, out);
    PyObject *code = PyBytes_FromStringAndSize((const char *)out, (Py_ssize_t)length);
    PyMem_Free(out);
    return code;
}

static PyObject *cobs_decode(PyObject *module, PyObject *argument) {
    (void)module;
    const uint8_t *code;
    size_t size;
    if (!get_bytes(argument, &code, &size))
        return NULL;
    if (size > 0 && memchr(code, 0, size) != NULL)
        Py_RETURN_NONE;
    uint8_t *out = PyMem_Malloc(size + 1);
    if (out == NULL)
        return PyErr_NoMemory();
    size_t length = cube_cobs_decode(code, size, out);
    PyObject *data = length == CUBE_NOT_COBS
                         ? Py_NewRef(Py_None)
                         : PyBytes_FromStringAndSize((const char *)out, (Py_ssize_t)length);
    PyMem_Free(out);
    return data;
}

/* One link to read, with the result of read(), or minus the errno of its error. */
typedef struct {
    Decoder *decoder;
    int fd;
    ssize_t result;
    bool no_memory;
} Link;

static void read_link(Link *link) {
    do {
        link->result = read(link->fd, link->decoder->input, READ_CHUNK);
    } while (link->result < 0 && errno == EINTR);
    if (link->result < 0)
        link->result = -errno;
}

static void decode_link(Link *link) {
    if (link->result > 0)
        link->no_memory = !decode(link->decoder, link->decoder->input, (size_t)link->result);
}

/* Reserves the decoders of a list of pairs (Decoder, file descriptor) for this call. Returns their
 * number; fewer than `count`: an exception is set. */
static Py_ssize_t take_links(PyObject *pairs, Link *links, Py_ssize_t count) {
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *pair = PyList_GetItem(pairs, i), *decoder;
        links[i] = (Link){.no_memory = false};
        if (!PyTuple_Check(pair)) {
            PyErr_SetString(PyExc_TypeError, "a link is a tuple (Decoder, file descriptor)");
            return i;
        }
        if (!PyArg_ParseTuple(pair, "O!i:read_links", decoder_type, &decoder, &links[i].fd) ||
            !is_free((Decoder *)decoder))
            return i;
        Py_INCREF(decoder);
        links[i].decoder = (Decoder *)decoder;
        links[i].decoder->is_busy = true;
    }
    return count;
}

/* Returns the results of all links, and releases their decoders. NULL: an exception is set. */
static PyObject *give_links(Link *links, Py_ssize_t count, bool is_read) {
    PyObject *results = is_read ? PyList_New(count) : NULL;
    for (Py_ssize_t i = 0; i < count; i++) {
        links[i].decoder->is_busy = false;
        if (results != NULL) {
            PyObject *frames =
                links[i].no_memory ? PyErr_NoMemory() : take_frames(links[i].decoder);
            PyObject *result =
                frames == NULL ? NULL : Py_BuildValue("(nN)", (Py_ssize_t)links[i].result, frames);
            if (result == NULL || PyList_SetItem(results, i, result) < 0)
                Py_CLEAR(results);
        }
        Py_DECREF(links[i].decoder);
    }
    return results;
}

static PyObject *read_links(PyObject *module, PyObject *args) {
    (void)module;
    PyObject *pairs, *clock, *arrival = NULL;
    if (!PyArg_ParseTuple(args, "O!O:read_links", &PyList_Type, &pairs, &clock))
        return NULL;
    Py_ssize_t count = PyList_Size(pairs);
    Link *links = PyMem_Malloc((size_t)count * sizeof *links);
    if (links == NULL)
        return PyErr_NoMemory();
    Py_ssize_t taken = take_links(pairs, links, count);
    if (taken == count) {
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < count; i++)
            read_link(&links[i]);
        Py_END_ALLOW_THREADS
        /* The clock is read between reading and decoding, so that the time is that of the bytes. */
        arrival = PyObject_CallNoArgs(clock);
    }
    if (arrival != NULL) {
        Py_BEGIN_ALLOW_THREADS
        for (Py_ssize_t i = 0; i < count; i++)
            decode_link(&links[i]);
        Py_END_ALLOW_THREADS
    }
    PyObject *results = give_links(links, taken, arrival != NULL);
    PyMem_Free(links);
    if (results == NULL) {
        Py_XDECREF(arrival);
        return NULL;
    }
    return Py_BuildValue("(NN)", arrival, results);
}

/* ------------------------------------------------------------------------------ rows ---------- */

/* Places of the columns of rows in one block of memory, one after the other. */
typedef struct {
    float *frequency;
    uint32_t *sequence;
    int64_t *stamp_ns;
    uint32_t *pad_fault;
    float *temperature;
    size_t n_pads;
} Columns;

static size_t columns_size(size_t n_rows, size_t n_pads) {
    return n_rows * (8 + 4 + 4 + 4 + 4 * n_pads);
}

static Columns columns_of(uint8_t *memory, size_t n_rows, size_t n_pads) {
    Columns columns = {.n_pads = n_pads};
    columns.stamp_ns = (int64_t *)(void *)memory;
    columns.sequence = (uint32_t *)(void *)(columns.stamp_ns + n_rows);
    columns.pad_fault = columns.sequence + n_rows;
    columns.temperature = (float *)(columns.pad_fault + n_rows);
    columns.frequency = columns.temperature + n_rows;
    return columns;
}

static uint32_t load_u32(const uint8_t *at) {
    return (uint32_t)at[0] | (uint32_t)at[1] << 8 | (uint32_t)at[2] << 16 | (uint32_t)at[3] << 24;
}

/* Writes the rows of one sample from row `start` on. */
static void place(const cube_frame *frame, int64_t stamp_ns, Columns *columns, size_t start) {
    size_t n_cubes = frame->as.sample.n_cubes, width = frame->as.sample.n_pads;
    const uint8_t *frequency = cube_frequency_bytes(frame);
    const uint8_t *pad_fault = cube_pad_fault_bytes(frame);
    for (size_t i = 0; i < n_cubes; i++) {
        size_t row = start + i;
        float *to = columns->frequency + row * columns->n_pads;
        for (size_t pad = 0; pad < width; pad++, frequency += 4) {
            uint32_t millihertz = load_u32(frequency);
            /* The product is computed in double precision: float cannot resolve 1 mHz of 100 kHz. */
            to[pad] = millihertz == CUBE_NOT_MEASURED ? NAN : (float)(1e-3 * (double)millihertz);
        }
        for (size_t pad = width; pad < columns->n_pads; pad++)
            to[pad] = NAN;
        int16_t centi = cube_temperature(frame, i);
        columns->stamp_ns[row] = stamp_ns;
        columns->sequence[row] = frame->as.sample.sequence;
        columns->pad_fault[row] = load_u32(pad_fault + 4 * i);
        columns->temperature[row] =
            centi == CUBE_TEMPERATURE_UNKNOWN ? NAN : (float)centi * 0.01f;
    }
}

/* Gets the frame in the bytes of a decoded SAMPLE. false: it is none, and an exception is set. */
static bool get_sample(PyObject *raw, cube_frame *frame) {
    if (!get_bytes(raw, &frame->raw, &frame->size))
        return false;
    if (cube_parse_sample(frame))
        return true;
    PyErr_SetString(PyExc_ValueError, "these bytes are no SAMPLE");
    return false;
}

static PyObject *place_rows(PyObject *module, PyObject *args) {
    (void)module;
    PyObject *raws, *stamps, *memory;
    Py_ssize_t pads;
    if (!PyArg_ParseTuple(
            args, "O!O!nO!:place_rows", &PyList_Type, &raws, &PyList_Type, &stamps, &pads,
            &PyByteArray_Type, &memory))
        return NULL;
    Py_ssize_t count = PyList_Size(raws);
    size_t n_rows = 0, n_pads = pads < 0 ? 0 : (size_t)pads;
    cube_frame frame;
    if (PyList_Size(stamps) != count) {
        PyErr_SetString(PyExc_ValueError, "there must be one stamp for each sample");
        return NULL;
    }
    for (Py_ssize_t i = 0; i < count; i++) {
        /* For an integer, PyLong_AsLongLong calls no Python code, which could change the lists. */
        if (!PyLong_Check(PyList_GetItem(stamps, i))) {
            PyErr_SetString(PyExc_TypeError, "a stamp is an integer");
            return NULL;
        }
        if (!get_sample(PyList_GetItem(raws, i), &frame))
            return NULL;
        if (frame.as.sample.n_pads > n_pads) {
            PyErr_SetString(PyExc_ValueError, "a sample has more pads than the rows");
            return NULL;
        }
        n_rows += frame.as.sample.n_cubes;
    }
    if ((size_t)PyByteArray_Size(memory) != columns_size(n_rows, n_pads)) {
        PyErr_SetString(PyExc_ValueError, "the memory must have the size of the rows");
        return NULL;
    }
    Columns columns = columns_of((uint8_t *)PyByteArray_AsString(memory), n_rows, n_pads);
    size_t row = 0;
    for (Py_ssize_t i = 0; i < count; i++) {
        int64_t stamp_ns = PyLong_AsLongLong(PyList_GetItem(stamps, i));
        if ((stamp_ns == -1 && PyErr_Occurred()) || !get_sample(PyList_GetItem(raws, i), &frame))
            return NULL;
        place(&frame, stamp_ns, &columns, row);
        row += frame.as.sample.n_cubes;
    }
    Py_RETURN_NONE;
}

/* ------------------------------------------------------------------------------ module -------- */

static PyMethodDef functions[] = {
    {"cobs_encode", cobs_encode, METH_O, NULL},
    {"cobs_decode", cobs_decode, METH_O, NULL},
    {"read_links", read_links, METH_VARARGS, NULL},
    {"place_rows", place_rows, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, .m_name = "_wire", .m_size = -1, .m_methods = functions};

PyMODINIT_FUNC PyInit__wire(void) {
    PyObject *made = PyModule_Create(&module);
    if (made == NULL)
        return NULL;
    decoder_type = (PyTypeObject *)PyType_FromSpec(&decoder_spec);
    if (decoder_type == NULL || PyModule_AddObject(made, "Decoder", (PyObject *)decoder_type) < 0) {
        Py_DECREF(made);
        return NULL;
    }
    return made;
}
