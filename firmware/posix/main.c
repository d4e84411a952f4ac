// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* cube_hub: hubs as a process, for hosts to be tried and loaded with.
 *
 * With CLOCK_MONOTONIC and a steady set of captures it costs what building and sending frames
 * costs, so it loads a host where the simulator would take a third of a core for itself. */
#define _GNU_SOURCE
#include <errno.h>
#include <getopt.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <time.h>

#include "hub.h"
#include "line.h"

#define MOST_HUBS 256
#define FIRST_CUBE_UID 0xC0BE000000000001u
#define COUNTER_HZ 125000000u
#define WINDOW_TICKS (COUNTER_HZ / 2000) /* captures of half a millisecond */

static const char usage[] =
    "usage: cube_hub (--ports DIR | --tcp PORT) [--hubs N] [--cubes N] [--pads N]\n"
    "                [--cubes-per-frame N] [--period US] [--uid UID] [--frequency HZ]\n"
    "                [--log FILE]\n"
    "Hubs on pseudo-terminals DIR/hub0, DIR/hub1, ... or on TCP ports of 127.0.0.1 from PORT on.\n"
    "The log has when each sample was taken.\n";

struct options {
    const char *ports, *log;
    unsigned tcp, hubs, cubes, pads, cubes_per_frame, period_us, frequency;
    unsigned uid;
};

struct one {
    struct hub hub;
    struct hub_config config;
    struct port port;
    uint64_t *cube_uids;
    char name[4096];
};

static volatile sig_atomic_t stopped;

static void stop(int number) {
    (void)number;
    stopped = 1;
}

/* A number from least to most, or the end of the program. */
static unsigned number(const char *text, unsigned least, unsigned most) {
    char *end;
    errno = 0;
    unsigned long value = strtoul(text, &end, 0);
    if (errno != 0 || *end != 0 || *text == '-' || value < least || value > most) {
        fprintf(stderr, "cube_hub: %s is no number from %u to %u\n%s", text, least, most, usage);
        exit(2);
    }
    return (unsigned)value;
}

static struct options parse(int argc, char **argv) {
    static const struct option flags[] = {
        {"ports", required_argument, NULL, 'd'},  {"tcp", required_argument, NULL, 't'},
        {"hubs", required_argument, NULL, 'h'},   {"cubes", required_argument, NULL, 'c'},
        {"pads", required_argument, NULL, 'p'},   {"cubes-per-frame", required_argument, NULL, 'f'},
        {"period", required_argument, NULL, 'T'}, {"uid", required_argument, NULL, 'u'},
        {"frequency", required_argument, NULL, 'F'}, {"log", required_argument, NULL, 'l'}, {0},
    };
    struct options options = {
        .hubs = 1, .cubes = 4, .pads = 8, .period_us = 10000, .frequency = 100000, .uid = 1};
    for (int flag; (flag = getopt_long(argc, argv, "", flags, NULL)) != -1;) {
        switch (flag) {
        case 'd': options.ports = optarg; break;
        case 't': options.tcp = number(optarg, 1, 65535); break;
        case 'h': options.hubs = number(optarg, 1, MOST_HUBS); break;
        case 'c': options.cubes = number(optarg, 0, 1000); break;
        case 'p': options.pads = number(optarg, 1, 32); break;
        case 'f': options.cubes_per_frame = number(optarg, 1, 1000); break;
        case 'T': options.period_us = number(optarg, 100, 10000000); break;
        case 'F': options.frequency = number(optarg, 20000, 4000000); break;
        case 'l': options.log = optarg; break;
        case 'u': options.uid = number(optarg, 0, UINT32_MAX - MOST_HUBS); break;
        default: fputs(usage, stderr); exit(2);
        }
    }
    bool fits = options.tcp + options.hubs <= 65536;
    if (optind != argc || (options.ports == NULL) == (options.tcp == 0) || !fits) {
        fputs(usage, stderr);
        exit(2);
    }
    if (options.cubes_per_frame == 0) { /* as many as one frame holds */
        unsigned most = (CUBE_MAX_PAYLOAD - CUBE_SAMPLE_SIZE(0u, 0u)) / CUBE_SAMPLE_ROW(options.pads);
        options.cubes_per_frame = options.cubes < most ? options.cubes : most;
    }
    return options;
}

static void *memory(size_t count, size_t size) {
    void *made = calloc(count + 1, size);
    if (made == NULL) {
        fputs("cube_hub: out of memory\n", stderr);
        exit(1);
    }
    return made;
}

/* Pad n runs at 20 n ppm more than the first, so that pads can be told apart. */
static struct capture *captures(const struct options *options) {
    size_t n_pads = (size_t)options->cubes * options->pads;
    struct capture *made = memory(n_pads, sizeof *made);
    for (size_t pad = 0; pad < n_pads; pad++) {
        double ticks = COUNTER_HZ / (options->frequency * (1.0 + 20e-6 * (double)pad));
        made[pad].periods = (uint32_t)(WINDOW_TICKS / ticks);
        made[pad].last = (uint32_t)(made[pad].periods * ticks + 0.5);
    }
    return made;
}

static bool begin(struct one *one, unsigned index, const struct options *options) {
    one->cube_uids = memory(options->cubes, sizeof(uint64_t));
    for (unsigned cube = 0; cube < options->cubes; cube++)
        one->cube_uids[cube] = FIRST_CUBE_UID + (uint64_t)index * options->cubes + cube;
    size_t row = CUBE_SAMPLE_ROW(options->pads);
    size_t sample = CUBE_WIRE_SIZE(CUBE_SAMPLE_SIZE(0u, 0u) + options->cubes_per_frame * row);
    size_t hello = CUBE_WIRE_SIZE(CUBE_HELLO_SIZE((size_t)options->cubes));
    size_t frame_size = sample > hello ? sample : hello;
    one->config = (struct hub_config){
        .uid = (uint64_t)options->uid + index,
        .cube_uids = one->cube_uids,
        .n_cubes = (uint16_t)options->cubes,
        .n_pads = (uint8_t)options->pads,
        .cubes_per_frame = (uint16_t)options->cubes_per_frame,
        .period_us = options->period_us,
        .min_period_us = 100,
        .max_period_us = 10000000,
        .frequency = memory((size_t)options->cubes * options->pads, sizeof(uint32_t)),
        .frame = memory(frame_size, 1),
        .frame_size = frame_size,
    };
    one->port.captures = captures(options);
    bool opened;
    if (options->ports != NULL) {
        snprintf(one->name, sizeof one->name, "%s/hub%u", options->ports, index);
        opened = line_open_terminal(&one->port, one->name);
    } else {
        snprintf(one->name, sizeof one->name, "socket://127.0.0.1:%u", options->tcp + index);
        opened = line_open_tcp(&one->port, one->name, (uint16_t)(options->tcp + index));
    }
    return opened && hub_begin(&one->hub, &one->config, &one->port);
}

static void finish(struct one *one) {
    line_close(&one->port);
    free(one->cube_uids);
    free(one->port.captures);
    free(one->config.frequency);
    free(one->config.frame);
}

/* The log begins with the wall clock at device time 0, ns; then each sample has 16 bytes: the hub
 * and the number of the sample as uint32_t, the device time as uint64_t, in the machine's order. */
static FILE *begin_log(const char *path) {
    FILE *log = fopen(path, "wb");
    if (log == NULL) {
        fprintf(stderr, "cube_hub: %s: %s\n", path, strerror(errno));
        exit(1);
    }
    uint64_t now_us = port_now_us(NULL);
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    int64_t start_ns = now.tv_sec * 1000000000 + now.tv_nsec - (int64_t)now_us * 1000;
    fwrite(&start_ns, sizeof start_ns, 1, log);
    return log;
}

static void write_log(FILE *log, uint32_t index, const struct one *one) {
    uint32_t head[2] = {index, one->hub.taken - 1};
    fwrite(head, sizeof head, 1, log);
    fwrite(&one->port.window_us, sizeof one->port.window_us, 1, log);
}

static void run(struct one *hubs, unsigned n_hubs, FILE *log) {
    struct pollfd events[MOST_HUBS];
    while (!stopped) {
        uint64_t due = UINT64_MAX;
        for (unsigned i = 0; i < n_hubs; i++) {
            line_accept(&hubs[i].port);
            uint32_t taken = hubs[i].hub.taken;
            uint64_t next = hub_step(&hubs[i].hub);
            if (log != NULL && hubs[i].hub.taken != taken)
                write_log(log, i, &hubs[i]);
            line_flush(&hubs[i].port);
            due = next < due ? next : due;
            events[i] = line_events(&hubs[i].port);
        }
        uint64_t now = port_now_us(NULL);
        uint64_t left = due > now ? due - now : 0;
        const struct timespec wait = {
            .tv_sec = (time_t)(left / 1000000), .tv_nsec = (long)(left % 1000000) * 1000};
        ppoll(events, n_hubs, &wait, NULL);
    }
}

int main(int argc, char **argv) {
    struct options options = parse(argc, argv);
    struct sigaction action = {.sa_handler = stop};
    sigaction(SIGINT, &action, NULL);
    sigaction(SIGTERM, &action, NULL);
    signal(SIGPIPE, SIG_IGN);
    prctl(PR_SET_TIMERSLACK, 1ul);
    struct one *hubs = memory(options.hubs, sizeof *hubs);
    unsigned begun = 0;
    while (begun < options.hubs && begin(&hubs[begun], begun, &options))
        begun++;
    if (begun == options.hubs) {
        for (unsigned i = 0; i < begun; i++)
            printf("%s\n", hubs[i].name);
        fflush(stdout);
        FILE *log = options.log != NULL ? begin_log(options.log) : NULL;
        run(hubs, begun, log);
        if (log != NULL)
            fclose(log);
    }
    for (unsigned i = 0; i < begun; i++) {
        printf("%s: %u taken, %u dropped\n", hubs[i].name, hubs[i].hub.taken, hubs[i].hub.dropped);
        finish(&hubs[i]);
    }
    free(hubs);
    return begun == options.hubs ? 0 : 1;
}
