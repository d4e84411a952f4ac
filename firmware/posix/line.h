// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Port of a hub that is a part of a process: its line is a pseudo-terminal or a TCP socket, its
 * pads are oscillators at rest. */
#ifndef LINE_H
#define LINE_H

#include <poll.h>

#include "port.h"

#define LINE_ROOM 65536 /* bytes that wait for a host that does not read */

struct port {
    const char *name;          /* for messages */
    int fd;                    /* the line; -1 without a TCP connection */
    int other;                 /* the far end of the pseudo-terminal, or the listening socket */
    bool is_tcp;
    uint8_t out[LINE_ROOM];
    size_t begin, end;         /* of the bytes in `out` */
    uint64_t window_us;        /* when the window began */
    struct capture *captures;  /* of all pads, always the same */
};

/* Appears as the symbolic link `path`, which is replaced; or listens at a TCP port of 127.0.0.1.
 * false, and a message on stderr: that does not work. */
bool line_open_terminal(struct port *, const char *path);
bool line_open_tcp(struct port *, const char *name, uint16_t tcp_port);

/* Writes what the line takes now; accepts a host. */
void line_flush(struct port *);
void line_accept(struct port *);

/* What to wait for. */
struct pollfd line_events(const struct port *);

/* Vanishes. */
void line_close(struct port *);

#endif
