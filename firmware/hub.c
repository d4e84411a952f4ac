// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* See hub.h. One thing is sent at a time: while frames of a sample wait for room, requests and the
 * frames of the second wait behind them. So STATS follows the samples that it counts, and no sample
 * follows the ACK of STOP. */
#include "hub.h"

#define SECOND_US 1000000u

uint32_t hub_frequency(const struct capture *edges, uint32_t counter_hz) {
    uint32_t ticks = edges->last - edges->first; /* the counter may have wrapped between them */
    if (edges->periods == 0 || ticks == 0)
        return CUBE_NOT_MEASURED;
    uint64_t periods_1000 = (uint64_t)edges->periods * 1000u;
    uint64_t millihertz = (periods_1000 * counter_hz + ticks / 2) / ticks;
    return millihertz <= UINT32_MAX ? (uint32_t)millihertz : CUBE_NOT_MEASURED;
}

/* Windows begin at whole multiples of the period, so that hubs with one clock sample together. */
static void schedule(struct hub *hub, uint64_t now_us) {
    hub->next_us = (now_us / hub->period_us + 1) * hub->period_us;
}

static size_t build_hello(struct hub *hub) {
    const struct hub_config *config = hub->config;
    const cube_hello hello = {
        .hub_uid = config->uid,
        .firmware = HUB_FIRMWARE,
        .n_cubes = config->n_cubes,
        .n_pads = config->n_pads,
        .period_us = hub->period_us,
    };
    return cube_build_hello(config->frame, config->frame_size, &hello, config->cube_uids);
}

static void send(struct hub *hub, size_t size) {
    port_send(hub->port, hub->config->frame, size);
}

bool hub_begin(struct hub *hub, const struct hub_config *config, struct port *port) {
    *hub = (struct hub){.config = config, .port = port, .period_us = config->period_us};
    hub->second_us = port_now_us(port);
    cube_decoder_init(&hub->decoder, hub->request, sizeof hub->request);
    size_t sample = CUBE_WIRE_SIZE(CUBE_SAMPLE_SIZE(config->cubes_per_frame, config->n_pads));
    size_t hello = CUBE_WIRE_SIZE(CUBE_HELLO_SIZE(config->n_cubes));
    bool fits = config->frame_size >= sample && config->frame_size >= hello;
    bool ends = config->cubes_per_frame > 0 || config->n_cubes == 0;
    return fits && ends && config->period_us > 0 && config->min_period_us > 0;
}

/* ------------------------------------------------------------------------------- requests ---- */

/* Room for the longest answer: an ACK and HELLO behind it. */
static size_t answer_size(const struct hub *hub) {
    return CUBE_WIRE_SIZE(CUBE_ACK_SIZE) + CUBE_WIRE_SIZE(CUBE_HELLO_SIZE(hub->config->n_cubes));
}

static void answer_time(struct hub *hub, uint32_t number) {
    const cube_time time = {.number = number, .device_us = port_now_us(hub->port)};
    send(hub, cube_build_time(hub->config->frame, hub->config->frame_size, &time));
}

static void answer(struct hub *hub, const cube_request *request) {
    const struct hub_config *config = hub->config;
    cube_ack ack = {.request = request->request, .result = CUBE_DONE};
    switch (request->request) {
    case CUBE_ASK_HELLO:
        break;
    case CUBE_START:
        if (!hub->started)
            schedule(hub, port_now_us(hub->port));
        hub->started = true;
        break;
    case CUBE_STOP:
        hub->started = hub->measuring = false;
        break;
    case CUBE_SET_PERIOD:
        if (request->argument < config->min_period_us || request->argument > config->max_period_us)
            ack.result = CUBE_REFUSED;
        else if (request->argument != hub->period_us) {
            hub->period_us = request->argument;
            schedule(hub, port_now_us(hub->port));
        }
        ack.argument = hub->period_us;
        break;
    case CUBE_IDENTIFY:
        port_identify(hub->port, request->argument);
        break;
    case CUBE_ASK_TIME:
        answer_time(hub, request->argument);
        return;
    default:
        ack.result = CUBE_UNKNOWN;
    }
    send(hub, cube_build_ack(config->frame, config->frame_size, &ack));
    if (request->request == CUBE_ASK_HELLO)
        send(hub, build_hello(hub));
}

/* Answers all requests that have come, as long as there is room for the answers. */
static void receive(struct hub *hub) {
    while (port_room(hub->port) >= answer_size(hub)) {
        if (hub->unread_at == hub->unread_end) {
            hub->unread_at = 0;
            hub->unread_end = port_receive(hub->port, hub->unread, sizeof hub->unread);
            if (hub->unread_end == 0)
                return;
        }
        cube_frame frame;
        hub->unread_at += cube_decode(
            &hub->decoder, hub->unread + hub->unread_at, hub->unread_end - hub->unread_at, &frame);
        if (frame.type == CUBE_REQUEST)
            answer(hub, &frame.as.request);
    }
}

/* -------------------------------------------------------------------------------- samples ---- */

/* Sends the frames of the last sample, as many as there is room for. */
static void send_sample(struct hub *hub) {
    const struct hub_config *config = hub->config;
    while (hub->sending) {
        cube_sample frame = hub->sample;
        uint16_t left = (uint16_t)(config->n_cubes - frame.first_cube);
        frame.n_cubes = left < config->cubes_per_frame ? left : config->cubes_per_frame;
        size_t most = CUBE_WIRE_SIZE(CUBE_SAMPLE_SIZE(frame.n_cubes, frame.n_pads));
        if (port_room(hub->port) < most)
            return;
        const uint32_t *frequency = config->frequency + (size_t)frame.first_cube * frame.n_pads;
        send(hub, cube_build_sample(
            config->frame, config->frame_size, &frame, frequency, NULL, NULL));
        hub->sample.first_cube = (uint16_t)(frame.first_cube + frame.n_cubes);
        hub->sending = hub->sample.first_cube < config->n_cubes;
    }
}

/* A window has ended: its sample is taken, or dropped if the one before it still waits for room. */
static void take_sample(struct hub *hub, const struct capture *captures, uint64_t middle_us) {
    const struct hub_config *config = hub->config;
    uint32_t number = hub->taken++;
    if (hub->sending) {
        hub->dropped++;
        return;
    }
    uint32_t counter_hz = port_counter_hz(hub->port);
    size_t n_pads = (size_t)config->n_cubes * config->n_pads;
    for (size_t pad = 0; pad < n_pads; pad++)
        config->frequency[pad] = hub_frequency(&captures[pad], counter_hz);
    hub->sample =
        (cube_sample){.sequence = number, .device_us = middle_us, .n_pads = config->n_pads};
    hub->sending = true;
}

static void measure(struct hub *hub, uint64_t now_us) {
    if (hub->started && !hub->measuring && now_us >= hub->next_us) {
        port_begin_window(hub->port);
        hub->measuring = true;
        hub->next_us += hub->period_us;
        if (hub->next_us <= now_us) /* too late for some: these are never taken */
            schedule(hub, now_us);
    }
    if (!hub->measuring)
        return;
    uint64_t middle_us;
    const struct capture *captures = port_window(hub->port, &middle_us);
    if (captures == NULL)
        return;
    hub->measuring = false;
    take_sample(hub, captures, middle_us);
}

/* ------------------------------------------------------------------------------- the step ---- */

/* HELLO and STATS, once a second. */
static void tell(struct hub *hub, uint64_t now_us) {
    size_t hello = CUBE_WIRE_SIZE(CUBE_HELLO_SIZE(hub->config->n_cubes));
    if (now_us < hub->second_us ||
        port_room(hub->port) < hello + CUBE_WIRE_SIZE(CUBE_STATS_SIZE))
        return;
    const cube_stats stats = {
        .uptime_ms = now_us / 1000,
        .taken = hub->taken,
        .dropped = hub->dropped,
        .supply_mv = port_supply_mv(hub->port),
    };
    send(hub, build_hello(hub));
    send(hub, cube_build_stats(hub->config->frame, hub->config->frame_size, &stats));
    hub->second_us += SECOND_US;
    if (hub->second_us <= now_us)
        hub->second_us = now_us + SECOND_US;
}

uint64_t hub_step(struct hub *hub) {
    uint64_t now_us = port_now_us(hub->port);
    send_sample(hub); /* what waited: else the next sample would be dropped */
    measure(hub, now_us);
    send_sample(hub);
    if (!hub->sending) {
        receive(hub);
        tell(hub, now_us);
    }
    return hub->started && hub->next_us < hub->second_us ? hub->next_us : hub->second_us;
}
