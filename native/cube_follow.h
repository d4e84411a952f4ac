/* The usual samples of a link: each is the next one, comes when it is due, and is no earlier than
 * the line of its hub's clock allows.
 *
 * They change running values alone. Whatever is decided about a link is decided in Python
 * (device/scans/sequence.py, clock_step.py and clock.py), which lends these values and takes them back.
 * The arithmetic is Python's, to the last bit. */
#ifndef CUBE_FOLLOW_H
#define CUBE_FOLLOW_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* So many samples are followed in a row, then Python looks at one. */
#define CUBE_FOLLOWED 64u

/* Times of the hub are below 2^50 us and those of the host below 2^62 ns, or nothing is lent.
 *
 * sequence, device_us: of the last sample; taken_us: of all that were followed, `count` of them
 * period_us, due_us, lag_us, is_due: as in StepWatch
 * offset_ns, drift: of the line below all points; stamp_offset_ns: of the one that gives stamps
 * first_us, first_ns: where both count from; newest_ns: device time of the newest sample from there
 * arrival_ns, stamp_ns: of the last sample; bucket_end_ns: when Python looks again
 * jitter_ns: mean height above the line; least_ns, earliest_ns, delay_ns: the lowest point */
typedef struct {
    uint32_t sequence;
    long long device_us;
    double period_us, due_us, lag_us;
    bool is_due;
    long long first_us, first_ns;
    double offset_ns, drift, stamp_offset_ns;
    long long newest_ns, arrival_ns, stamp_ns, bucket_end_ns;
    double jitter_ns, least_ns, earliest_ns, delay_ns;
    unsigned count;
    int64_t taken_us[CUBE_FOLLOWED];
} cube_follower;

/* Follows samples that arrived together, and writes the stamp of each. false: one of them is not
 * usual, and nothing has changed.
 *
 * sequence, device_us: `n` of each, at least one, in the order in which they came. */
bool cube_follow(
    cube_follower *follower, const uint32_t *sequence, const uint64_t *device_us, size_t n,
    int64_t arrival_ns, int64_t *stamp_ns);

#endif
