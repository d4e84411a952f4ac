// Copyright 2026 cube_tensor_driver authors
// SPDX-License-Identifier: Apache-2.0

/* See cube_track.h. */
#include "cube_track.h"

#include <math.h>

/* device/clock and device/track.py define the same constants and give the reasons for the values. */
#define MAX_DEVICE_US ((uint64_t)1 << 51)
#define MIN_STEP_US 4000.0
#define PERIOD_SAMPLES 64
#define JITTER_POINTS 64
#define MAX_DELAY_NS 60000000000
#define MAX_PAUSE_NS 60000000000

/* Updates the estimate of the sample period, as `HubClock._find_step` does. Returns false if the
 * device time deviates from what this period predicts. */
static bool follow_period(cube_track_head *track, const cube_sample *sample) {
    uint32_t n_periods = sample->sequence - (uint32_t)track->reference;
    double interval = (double)((int64_t)sample->device_us - track->reference_us);
    double error = interval - n_periods * track->period_us;
    if (fabs(error) > MIN_STEP_US)
        return false;
    double bound = track->period_us / PERIOD_SAMPLES;
    track->period_us += fmin(fmax(error, -bound), bound) / PERIOD_SAMPLES;
    track->reference = sample->sequence;
    track->reference_us = (int64_t)sample->device_us;
    return true;
}

/* Adds a point (device time, arrival time) to the line that converts device time to host time, as
 * `ClockLine.add` does. Returns false if the line must change: the point lies below it, or is the
 * first after a second of points, of which the earliest is then added. */
static bool follow_line(
    cube_track_head *track, int64_t device_ns, int64_t arrival_ns, bool is_late) {
    double height = (double)(arrival_ns - device_ns) - track->offset - track->drift * (double)device_ns;
    if (!(height >= 0) || (double)arrival_ns >= track->bucket_end)
        return false;
    track->jitter_ns += (height - track->jitter_ns) / JITTER_POINTS;
    if (height < track->bucket_height && !is_late) {
        track->bucket_height = height;
        track->earliest_ns = (double)device_ns;
    }
    return true;
}

/* Converts a device time to host time, as `HubClock._convert` does. Returns false if the result is not
 * credible or precedes the last time stamp. */
static bool stamp(cube_track_head *track, int64_t device_ns, int64_t arrival_ns, int64_t *stamp_ns) {
    double correction = track->bounded_offset + track->drift * (double)device_ns;
    *stamp_ns = track->first_ns + device_ns + llrint(correction); /* rounds halves to even, as Python does */
    int64_t delay_ns = arrival_ns - *stamp_ns;
    if (delay_ns < 0 || delay_ns > MAX_DELAY_NS || *stamp_ns < track->last_stamp_ns)
        return false;
    track->newest_ns = device_ns;
    track->last_stamp_ns = *stamp_ns;
    return true;
}

bool cube_follow(
    cube_track *track, const cube_sample *samples, size_t count, int64_t arrival_ns, bool is_late,
    int64_t *stamps_ns) {
    cube_track_head head = track->head;
    int64_t pause_ns = arrival_ns - head.last_arrival_ns;
    if (!head.is_native_allowed || count == 0 || pause_ns < 0 || pause_ns > MAX_PAUSE_NS)
        return false;
    for (size_t i = 0; i < count; i++) {
        const cube_sample *sample = &samples[i];
        if (sample->first_cube != 0 || sample->n_cubes != head.n_cubes ||
            sample->n_pads != head.n_pads || sample->sequence != (uint32_t)head.next ||
            sample->device_us > MAX_DEVICE_US || (int64_t)sample->device_us <= head.newest_us ||
            !follow_period(&head, sample))
            return false;
        head.next++;
        head.newest_us = (int64_t)sample->device_us;
    }
    head.last_arrival_ns = arrival_ns;
    int64_t newest_ns = 1000 * (head.newest_us - head.first_us);
    if (!follow_line(&head, newest_ns, arrival_ns - head.first_ns, is_late))
        return false;
    for (size_t i = 0; i < count; i++) {
        int64_t device_ns = 1000 * ((int64_t)samples[i].device_us - head.first_us);
        if (!stamp(&head, device_ns, arrival_ns, &stamps_ns[i]))
            return false;
    }
    for (size_t i = 0; i < count; i++) {
        int64_t number = track->head.next + (int64_t)i;
        int64_t *seen = track->seen[number % CUBE_TRACK_SEEN];
        seen[0] = number;
        seen[1] = (int64_t)samples[i].device_us;
    }
    head.n_native += (int64_t)count;
    track->head = head;
    return true;
}
