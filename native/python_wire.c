// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* The Python module cube_tensor_driver._wire: cube_wire.h for cube_tensor_driver/device/wire/native.py.
 *
 * Plain C API of Python, limited to the stable ABI of 3.10: one build serves all later versions.
 * The functions and their contracts for Python stand in cube_tensor_driver/_wire.pyi. What makes no
 * Python object runs without the interpreter's lock. */
#define PY_SSIZE_T_CLEAN
#define Py_LIMITED_API 0x030A0000
#include <Python.h>

#include "cube_track.h"
#include "cube_wire.h"

#include <errno.h>
#include <math.h>
#include <poll.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

#define READ_CHUNK 65536
#define MAX_USUAL 64         /* samples in one usual read of one link */
#define MAX_LATE_ROUNDS 16   /* reads of one link by a host that is behind, before it handles them */
#define WAIT_STEP_NS 200000L /* between two looks for the samples of other links */

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

/* One link to read.
 *
 * result: of read(), or minus the errno of its error; 0 where nothing was read.
 * count: number of its samples if the read was usual (cube_track.h); 0: it was not. */
typedef struct {
    Decoder *decoder;
    cube_track *track;
    ssize_t result;
    bool was_read, has_frames, no_memory;
    size_t count;
    int64_t stamps_ns[MAX_USUAL];
} Link;

static void read_link(Link *link, struct pollfd *polled) {
    do {
        link->result = read(polled->fd, link->decoder->input, READ_CHUNK);
    } while (link->result < 0 && errno == EINTR);
    if (link->result < 0)
        link->result = -errno;
    link->was_read = link->result != -EAGAIN;
    if (link->was_read && link->result <= 0)
        polled->fd = -1; /* it has ended, and poll would return at once for it again */
}

/* Decodes what was read, and takes the samples where all frames are usual ones. */
static void decode_link(Link *link, int64_t arrival_ns, bool is_late) {
    Decoder *decoder = link->decoder;
    link->count = 0;
    if (link->result <= 0)
        return;
    link->no_memory = !decode(decoder, decoder->input, (size_t)link->result);
    cube_sample samples[MAX_USUAL];
    size_t count = 0;
    for (size_t at = 0; at < decoder->used; count++) {
        uint32_t length;
        memcpy(&length, decoder->frames + at, sizeof length);
        cube_frame frame = {.raw = decoder->frames + at + sizeof length, .size = length};
        at += sizeof length + length;
        link->has_frames = true;
        if (count == MAX_USUAL || !cube_parse_sample(&frame)) {
            link->track->head.is_native_allowed = false;
            return;
        }
        samples[count] = frame.as.sample;
    }
    if (count == 0)
        return;
    if (cube_follow(link->track, samples, count, arrival_ns, is_late, link->stamps_ns))
        link->count = count;
    else /* what follows must wait until the interpreter has handled this read */
        link->track->head.is_native_allowed = false;
}

/* Reserves the decoders of a list of tuples (Decoder, file descriptor, address of a cube_track) for
 * this call. Returns their number; fewer than `count`: an exception is set. */
static Py_ssize_t take_links(PyObject *list, Link *links, struct pollfd *polled, Py_ssize_t count) {
    for (Py_ssize_t i = 0; i < count; i++) {
        PyObject *tuple = PyList_GetItem(list, i), *decoder, *address;
        if (!PyTuple_Check(tuple)) {
            PyErr_SetString(PyExc_TypeError, "a link is (Decoder, file descriptor, address)");
            return i;
        }
        polled[i] = (struct pollfd){.events = POLLIN};
        links[i] = (Link){.count = 0};
        if (!PyArg_ParseTuple(
                tuple, "O!iO!:read_links", decoder_type, &decoder, &polled[i].fd, &PyLong_Type,
                &address) ||
            !is_free((Decoder *)decoder))
            return i;
        links[i].track = PyLong_AsVoidPtr(address);
        if (PyErr_Occurred())
            return i;
        Py_INCREF(decoder);
        links[i].decoder = (Decoder *)decoder;
        links[i].decoder->is_busy = true;
    }
    return count;
}

/* Appends to a list and gives up the reference. false: an exception is set. */
static bool append(PyObject *list, PyObject *item) {
    bool is_right = item != NULL && PyList_Append(list, item) == 0;
    Py_XDECREF(item);
    return is_right;
}

/* Adds what was read from a link to the lists of the result. false: an exception is set. */
static bool give_link(PyObject *result, Link *link, Py_ssize_t index, int64_t arrival_ns) {
    bool is_event = link->result <= 0 || (link->count == 0 && link->decoder->used > 0);
    PyObject *frames = link->no_memory ? PyErr_NoMemory() : take_frames(link->decoder);
    if (frames == NULL)
        return false;
    if (is_event)
        return append(
            PyTuple_GetItem(result, 4), Py_BuildValue(
                                            "(nLnN)", index, (long long)arrival_ns,
                                            (Py_ssize_t)link->result, frames));
    bool is_right = true;
    for (size_t i = 0; i < link->count && is_right; i++) {
        PyObject *raw = PyList_GetItem(frames, (Py_ssize_t)i);
        is_right = append(PyTuple_GetItem(result, 1), PyLong_FromSsize_t(index)) &&
                   PyList_Append(PyTuple_GetItem(result, 2), raw) == 0 &&
                   append(PyTuple_GetItem(result, 3), PyLong_FromLongLong(link->stamps_ns[i]));
    }
    Py_DECREF(frames);
    return is_right;
}

static int64_t steady_ns(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

/* Reads all links that have data once, decodes them and adds the results. false: an exception. */
static bool read_round(
    PyObject *result, Link *links, struct pollfd *polled, Py_ssize_t count, PyObject *clock,
    bool is_late) {
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < count; i++) {
        links[i].was_read = false;
        if (polled[i].revents != 0)
            read_link(&links[i], &polled[i]);
    }
    Py_END_ALLOW_THREADS
    /* The clock is read between reading and decoding, so that the time is that of the bytes. */
    PyObject *time = PyObject_CallNoArgs(clock);
    int64_t arrival_ns = time == NULL ? -1 : PyLong_AsLongLong(time);
    Py_XDECREF(time);
    if (arrival_ns == -1 && PyErr_Occurred())
        return false;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < count; i++)
        if (links[i].was_read)
            decode_link(&links[i], arrival_ns, is_late);
    Py_END_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < count; i++)
        if (links[i].was_read && !give_link(result, &links[i], i, arrival_ns))
            return false;
    return true;
}

/* Reads what is there, and waits up to gather_ns until `expected` links have delivered frames. A
 * host that is behind does not wait, but reads all that has come. */
static bool read_rounds(
    PyObject *result, Link *links, struct pollfd *polled, Py_ssize_t count, PyObject *clock,
    bool is_late, Py_ssize_t expected, int64_t gather_ns) {
    int64_t begin_ns = steady_ns();
    for (int round = 1;; round++) {
        if (!read_round(result, links, polled, count, clock, is_late))
            return false;
        Py_ssize_t delivered = 0;
        for (Py_ssize_t i = 0; i < count; i++)
            delivered += links[i].has_frames;
        bool is_waiting = 0 < delivered && delivered < expected;
        if (is_late ? round == MAX_LATE_ROUNDS
                    : !is_waiting || steady_ns() - begin_ns >= gather_ns)
            return true;
        struct timespec step = {.tv_nsec = WAIT_STEP_NS};
        int ready;
        Py_BEGIN_ALLOW_THREADS
        if (!is_late)
            nanosleep(&step, NULL);
        ready = poll(polled, (nfds_t)count, 0);
        Py_END_ALLOW_THREADS
        if (is_late && ready == 0)
            return true;
    }
}

static PyObject *read_links(PyObject *module, PyObject *args) {
    (void)module;
    PyObject *list, *clock;
    int wake_fd;
    double timeout_s, gather_s;
    Py_ssize_t expected;
    if (!PyArg_ParseTuple(
            args, "O!iddnO:read_links", &PyList_Type, &list, &wake_fd, &timeout_s, &gather_s,
            &expected, &clock))
        return NULL;
    Py_ssize_t count = PyList_Size(list);
    Link *links = PyMem_Calloc((size_t)count + 1, sizeof *links);
    struct pollfd *polled = PyMem_Calloc((size_t)count + 1, sizeof *polled);
    PyObject *result = NULL;
    Py_ssize_t taken = 0;
    if (links == NULL || polled == NULL) {
        PyErr_NoMemory();
    } else if ((taken = take_links(list, links, polled, count)) == count) {
        polled[count] = (struct pollfd){.fd = wake_fd, .events = POLLIN};
        int ready;
        bool is_late;
        Py_BEGIN_ALLOW_THREADS
        ready = poll(polled, (nfds_t)count + 1, 0);
        is_late = ready > 0;
        if (!is_late)
            ready = poll(polled, (nfds_t)count + 1, (int)(1e3 * timeout_s + 0.999));
        if (polled[count].revents != 0) {
            uint8_t discarded[64];
            ready += read(wake_fd, discarded, sizeof discarded) < 0; /* it is empty already */
        }
        Py_END_ALLOW_THREADS
        result = Py_BuildValue("(N[][][][])", PyBool_FromLong(is_late));
        if (result != NULL && ready > 0 &&
            !read_rounds(
                result, links, polled, count, clock, is_late, expected, (int64_t)(1e9 * gather_s)))
            Py_CLEAR(result);
    }
    for (Py_ssize_t i = 0; i < taken; i++) {
        links[i].decoder->is_busy = false;
        Py_DECREF(links[i].decoder);
    }
    PyMem_Free(links);
    PyMem_Free(polled);
    return result;
}

/* ------------------------------------------------------------------------------ rows ---------- */

/* Columns of rows, each contiguous. */
typedef struct {
    int64_t *stamp_ns;
    uint32_t *sequence;
    uint32_t *pad_fault;
    float *temperature;
    float *frequency;
    size_t n_pads;
} Columns;

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
    PyObject *raws, *stamps;
    Py_ssize_t rows, pads;
    unsigned long long at[5]; /* addresses of the columns */
    if (!PyArg_ParseTuple(
            args, "O!O!nn(KKKKK):place_rows", &PyList_Type, &raws, &PyList_Type, &stamps, &rows,
            &pads, &at[0], &at[1], &at[2], &at[3], &at[4]))
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
    if (rows < 0 || n_rows != (size_t)rows) {
        PyErr_SetString(PyExc_ValueError, "there must be one row for each cube of the samples");
        return NULL;
    }
    Columns columns = {
        .stamp_ns = (int64_t *)(uintptr_t)at[0],
        .sequence = (uint32_t *)(uintptr_t)at[1],
        .pad_fault = (uint32_t *)(uintptr_t)at[2],
        .temperature = (float *)(uintptr_t)at[3],
        .frequency = (float *)(uintptr_t)at[4],
        .n_pads = n_pads,
    };
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
    if (made == NULL || PyModule_AddIntConstant(made, "TRACK_SIZE", sizeof(cube_track)) < 0)
        return NULL;
    decoder_type = (PyTypeObject *)PyType_FromSpec(&decoder_spec);
    if (decoder_type == NULL || PyModule_AddObject(made, "Decoder", (PyObject *)decoder_type) < 0) {
        Py_DECREF(made);
        return NULL;
    }
    return made;
}
