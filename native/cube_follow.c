/* See cube_follow.h. */
#include "cube_follow.h"

#include <math.h>

/* As in device/clock/step.py, */
#define STEP_US 4000.0
#define SLACK 1e-3
#define QUIET_US 2.0
#define MEMORY_US 50000.0
#define SMOOTHING 64
/* in device/clock/line.py, */
#define JITTER_SMOOTHING 64
/* and in device/clock/clock.py. */
#define MAX_DELAY_NS INT64_C(60000000000)

#define MAX_DEVICE_US (INT64_C(1) << 50)
#define MAX_NS 1e18

/* StepWatch.look for the next sample. false: the clock may have been set. */
static bool is_in_time(cube_follower *f, int64_t device_us) {
    double late = (double)device_us - f->due_us;
    if (f->is_due && -QUIET_US < late && late < QUIET_US) {
        f->due_us = (double)device_us + f->period_us;
        return true;
    }
    double error = (double)(device_us - f->device_us) - f->period_us;
    double kept = 1 - f->period_us / MEMORY_US;
    f->lag_us = error + f->lag_us * (kept > 0.0 ? kept : 0.0);
    if (fabs(f->lag_us) > STEP_US + SLACK * f->period_us)
        return false;
    double bound = f->period_us / SMOOTHING;
    f->period_us += (error < -bound ? -bound : error > bound ? bound : error) / SMOOTHING;
    f->is_due = fabs(f->lag_us) < QUIET_US;
    if (f->is_due) {
        f->due_us = (double)device_us + f->period_us;
        f->lag_us = 0.0;
    }
    return true;
}

/* ClockMap._add_point. false: the line falls. */
static bool is_above_line(cube_follower *f, int64_t t_ns, int64_t arrival_ns) {
    double t = (double)t_ns;
    double delay = (double)(arrival_ns - f->first_ns) - t;
    double height = delay - f->offset_ns - f->drift * t;
    if (!(height >= 0.0))
        return false;
    f->jitter_ns += (height - f->jitter_ns) / JITTER_SMOOTHING;
    if (height < f->least_ns) {
        f->least_ns = height;
        f->earliest_ns = t;
        f->delay_ns = delay;
    }
    return true;
}

/* ClockMap._stamps of one sample. false: its stamp would go back, or is no time at all. */
static bool has_stamp(cube_follower *f, int64_t t_ns, int64_t arrival_ns, int64_t *stamp_ns) {
    double ahead = f->stamp_offset_ns + f->drift * (double)t_ns;
    if (!(fabs(ahead) < MAX_NS))
        return false;
    int64_t stamp = f->first_ns + t_ns + llrint(ahead);
    stamp = stamp < arrival_ns ? stamp : arrival_ns;
    if (stamp < f->stamp_ns || stamp < arrival_ns - MAX_DELAY_NS)
        return false;
    f->stamp_ns = *stamp_ns = stamp;
    return true;
}

bool cube_follow(
    cube_follower *follower, const uint32_t *sequence, const uint64_t *device_us, size_t n,
    int64_t arrival_ns, int64_t *stamp_ns) {
    cube_follower f = *follower;
    if (n == 0 || n > CUBE_FOLLOWED - f.count || arrival_ns < f.arrival_ns ||
        arrival_ns >= f.bucket_end_ns)
        return false;
    for (size_t i = 0; i < n; i++) {
        /* Where numbers begin again, Python looks. */
        if (f.sequence == UINT32_MAX || sequence[i] != f.sequence + 1 ||
            device_us[i] >= (uint64_t)MAX_DEVICE_US)
            return false;
        int64_t now_us = (int64_t)device_us[i], t_ns = 1000 * (now_us - f.first_us);
        if (now_us <= f.device_us || t_ns <= f.newest_ns || !is_in_time(&f, now_us))
            return false;
        f.sequence++;
        f.device_us = f.taken_us[f.count++] = now_us;
        f.newest_ns = t_ns;
    }
    /* Of samples that arrive together the newest waited least; only it can touch the line. */
    if (!is_above_line(&f, f.newest_ns, arrival_ns))
        return false;
    for (size_t i = 0; i < n; i++) {
        int64_t t_ns = 1000 * ((int64_t)device_us[i] - f.first_us);
        if (!has_stamp(&f, t_ns, arrival_ns, &stamp_ns[i]))
            return false;
    }
    f.arrival_ns = arrival_ns;
    *follower = f;
    return true;
}
