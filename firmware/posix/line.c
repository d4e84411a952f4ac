// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* See line.h. */
#define _GNU_SOURCE
#include "line.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define COUNTER_HZ 125000000u

/* ---------------------------------------------------------------------------------- lines ---- */

static bool complain(const struct port *line) {
    fprintf(stderr, "cube_hub: %s: %s\n", line->name, strerror(errno));
    return false;
}

bool line_open_terminal(struct port *line, const char *path) {
    line->name = path;
    line->is_tcp = false;
    line->fd = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (line->fd < 0 || grantpt(line->fd) != 0 || unlockpt(line->fd) != 0)
        return complain(line);
    const char *terminal = ptsname(line->fd);
    if (terminal == NULL)
        return complain(line);
    /* The far end stays open: else the near one reports an error whenever the host closes it. */
    line->other = open(terminal, O_RDWR | O_NOCTTY);
    struct termios settings;
    if (line->other < 0 || tcgetattr(line->other, &settings) != 0)
        return complain(line);
    cfmakeraw(&settings);
    if (tcsetattr(line->other, TCSANOW, &settings) != 0)
        return complain(line);
    /* The link that a process left behind is replaced, but no file of somebody else. */
    struct stat there;
    if (lstat(path, &there) == 0 && S_ISLNK(there.st_mode))
        unlink(path);
    return symlink(terminal, path) == 0 || complain(line);
}

bool line_open_tcp(struct port *line, const char *name, uint16_t tcp_port) {
    line->name = name;
    line->is_tcp = true;
    line->fd = -1;
    line->other = socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK, 0);
    const int yes = 1;
    const struct sockaddr_in address = {
        .sin_family = AF_INET,
        .sin_port = htons(tcp_port),
        .sin_addr.s_addr = htonl(INADDR_LOOPBACK),
    };
    return (line->other >= 0 &&
            setsockopt(line->other, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) == 0 &&
            bind(line->other, (const struct sockaddr *)&address, sizeof address) == 0 &&
            listen(line->other, 1) == 0) ||
           complain(line);
}

static void hang_up(struct port *line) {
    close(line->fd);
    line->fd = -1;
}

void line_accept(struct port *line) {
    if (!line->is_tcp || line->fd >= 0)
        return;
    line->fd = accept4(line->other, NULL, NULL, SOCK_NONBLOCK);
    const int yes = 1;
    if (line->fd >= 0)
        setsockopt(line->fd, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
}

/* Of a call that failed or found the end: whether the connection is gone. */
static void check_lost(struct port *line, ssize_t result) {
    bool later = result < 0 && (errno == EAGAIN || errno == EINTR);
    if (line->is_tcp && !later)
        hang_up(line);
}

void line_flush(struct port *line) {
    while (line->fd >= 0 && line->begin < line->end) {
        ssize_t sent = write(line->fd, line->out + line->begin, line->end - line->begin);
        if (sent <= 0) {
            check_lost(line, sent);
            return;
        }
        line->begin += (size_t)sent;
    }
}

struct pollfd line_events(const struct port *line) {
    bool waits = line->fd >= 0 && line->begin < line->end;
    return (struct pollfd){
        .fd = line->fd >= 0 ? line->fd : line->other,
        .events = (short)(waits ? POLLIN | POLLOUT : POLLIN),
    };
}

void line_close(struct port *line) {
    if (!line->is_tcp)
        unlink(line->name);
    if (line->fd >= 0)
        close(line->fd);
    if (line->other >= 0)
        close(line->other);
}

/* ----------------------------------------------------------------------------------- port ---- */

uint64_t port_now_us(struct port *line) {
    (void)line;
    static struct timespec power_up;
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    if (power_up.tv_sec == 0)
        power_up = now;
    int64_t ns = (now.tv_sec - power_up.tv_sec) * 1000000000 + now.tv_nsec - power_up.tv_nsec;
    return (uint64_t)ns / 1000;
}

size_t port_room(struct port *line) {
    if (line->begin > 0 && line->end > LINE_ROOM / 2) {
        memmove(line->out, line->out + line->begin, line->end - line->begin);
        line->end -= line->begin;
        line->begin = 0;
    }
    if (line->begin == line->end)
        line->begin = line->end = 0;
    return LINE_ROOM - line->end;
}

void port_send(struct port *line, const uint8_t *data, size_t size) {
    memcpy(line->out + line->end, data, size);
    line->end += size;
}

size_t port_receive(struct port *line, uint8_t *data, size_t size) {
    if (line->fd < 0)
        return 0;
    ssize_t got = read(line->fd, data, size);
    if (got > 0)
        return (size_t)got;
    check_lost(line, got);
    return 0;
}

/* The captures are known beforehand, so a window takes no time. */
void port_begin_window(struct port *line) {
    line->window_us = port_now_us(line);
}

const struct capture *port_window(struct port *line, uint64_t *middle_us) {
    *middle_us = line->window_us;
    return line->captures;
}

uint32_t port_counter_hz(struct port *line) {
    (void)line;
    return COUNTER_HZ;
}

void port_identify(struct port *line, uint32_t seconds) {
    printf("%s: this is the hub, for %u s\n", line->name, seconds);
    fflush(stdout);
}

uint16_t port_supply_mv(struct port *line) {
    (void)line;
    return 0;
}
