// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* Counts and time stamps the samples of one link, as long as they are usual (defined below).
 *
 * The structure is cube_tensor_driver/device/track.py's `LinkTrack`, whose memory the interpreter
 * and this code share. The equations are those of device/scans/sequence.py and device/clock/, which
 * handle every other sample; a test holds both equal.
 */
#ifndef CUBE_TRACK_H
#define CUBE_TRACK_H

#include "cube_wire.h"

#define CUBE_TRACK_SEEN 64

/* Names, units and origins are explained in track.py. */
typedef struct {
    int64_t is_native_allowed;
    int64_t n_native;
    int64_t n_cubes, n_pads;
    int64_t next, newest_us;
    int64_t reference, reference_us;
    int64_t first_us, first_ns;
    int64_t newest_ns, last_arrival_ns, last_stamp_ns;
    double period_us;
    double offset, bounded_offset, drift, jitter_ns;
    double bucket_end, bucket_height, earliest_ns;
} cube_track_head;

typedef struct {
    cube_track_head head;
    int64_t seen[CUBE_TRACK_SEEN][2]; /* sequence number n and device time in us, at index n % 64 */
} cube_track;

/* Counts and time stamps the samples of one read. Returns false if one of them is not usual; nothing
 * is changed then.
 *
 * A sample is usual if it has the next sequence number, all cubes of the hub, a device time that its
 * number predicts, and a delay that does not change the line from device time to host time.
 *
 * samples: `count` samples, in their order.
 * is_late: whether the host reads late, so that arrival_ns is no measure of the delay.
 * stamps_ns: written; the host time at which each sample was measured. */
bool cube_follow(
    cube_track *track, const cube_sample *samples, size_t count, int64_t arrival_ns, bool is_late,
    int64_t *stamps_ns);

#endif
