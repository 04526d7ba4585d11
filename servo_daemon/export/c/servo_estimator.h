@HEADER@
/* servo_estimator.h - the estimator of one drive for its own processor. C99, single precision, no heap, no library but
 * expf and sqrtf. One `servo_estimator` of sizeof(servo_estimator) bytes holds everything; see servo_estimator.c for
 * memory and time.
 *
 *     static servo_estimator e;
 *     servo_noise noise = {.voltage_std = 0.01f, .current_std = 0.02f, .position_std = 4e-4f, .torque_density = 0.0f};
 *     servo_estimator_start(&e, &noise, counts, 3.0f);        // from the exported values, or
 *     servo_estimator_start_unknown(&e, &noise, counts);      // from nothing, by least squares
 *     ...
 *     servo_estimator_sample(&e, 1e-3f, voltage, current, counts, SERVO_ALL_VALID);   // every sample
 *     if (servo_estimator_status(&e) == SERVO_TRACKING) { ... servo_estimator_value(&e, SERVO_R) ... }
 *
 * `voltage` is what is applied from this sample until the next; current and counts are of this sample's instant.
 * SPDX-License-Identifier: Apache-2.0
 */
#ifndef SERVO_ESTIMATOR_H
#define SERVO_ESTIMATOR_H

#include <stdint.h>

/* Parameters that are estimated. */
enum { @NAMES@, SERVO_PARAMETERS };
/* Their names as the daemon has them, for servo_wire_estimates. */
extern const char servo_parameter_names[SERVO_PARAMETERS][8];
/* Estimated quantities: current, speed, angle, then the parameters. */
enum { SERVO_CURRENT, SERVO_SPEED, SERVO_ANGLE, SERVO_STATES = 3 + SERVO_PARAMETERS };
/* Inductance, held, H. */
#define SERVO_L @L@
/* One count of the encoder in rad at the motor's shaft: 2 pi / counts per revolution@GEAR@. */
#ifndef SERVO_RAD_PER_COUNT
#error "define SERVO_RAD_PER_COUNT: what one count of your encoder is, rad at the motor's shaft"
#endif
/* 1: the linear motor and nothing else. */
#define SERVO_LINEAR @LINEAR@
/* Longest step that the series serves, s. */
#define SERVO_LONGEST_STEP_S @LONGEST@

typedef enum {
    SERVO_STARTING,   /* least squares, or the first samples: no value is to be used */
    SERVO_ESTIMATING, /* some parameter is known to worse than SERVO_KNOWN */
    SERVO_TRACKING,   /* all are known */
    SERVO_DOUBTFUL,   /* many outliers, or innovations larger than the noise or like their neighbours: the model does
                         not fit the motor, or the noise is not what it was said to be; the deviations are too small */
    SERVO_INVALID     /* numbers broke down; it has started again from where it began */
} servo_status;

enum { SERVO_CURRENT_VALID = 1, SERVO_POSITION_VALID = 2, SERVO_ALL_VALID = 3 };

/* 1 standard deviation of what the drive applies and measures (V, A, rad); a white load torque, (N m)^2 s. */
typedef struct {
    float voltage_std, current_std, position_std, torque_density;
    float walk[SERVO_PARAMETERS]; /* how fast each may change: variance of its logarithm (TL: itself) in a second */
} servo_noise;

typedef struct {
    float x[3];                                /* current A, speed rad/s, angle rad from base_counts */
    float trajectory[3];                       /* the same as the model alone has them */
    float p[SERVO_PARAMETERS];                 /* in SI units */
    float moved[SERVO_PARAMETERS];             /* what is estimated: log(p / start), of TL p - start */
    float start[SERVO_PARAMETERS];
    float U[SERVO_STATES][SERVO_STATES];       /* covariance U D U', U unit upper triangular */
    float D[SERVO_STATES];
    float voltage, age_s, start_std;
    float outliers, nis, lagged, last; /* of the last samples: share; the current's innovations in units of their
                                          standard deviation: mean square, product with the one before, the last */
    servo_noise noise;
    int32_t base_counts;
    uint32_t samples;
    uint8_t broken, walks, leaning;
    float slow_h, slow;
    /* Least squares: sums of the two balances over windows. */
    float see[5], smm[5], w_i, w_v, w_t, w_theta, w_omega, w_i0, last_i, last_theta;
    uint16_t in_window;
} servo_estimator;

/* Start from the exported values; each is believed to `wider` times its standard deviation (where the export has none:
 * 10 %). `counts`: the encoder now. */
void servo_estimator_start(servo_estimator *e, const servo_noise *noise, int32_t counts, float wider);
/* Start from these, believed to a relative `std` each (of TL: in N m). */
void servo_estimator_start_at(servo_estimator *e, const servo_noise *noise, int32_t counts, const float *values,
                              const float *std);
#if SERVO_LINEAR
/* Start from nothing known but L: least squares over the two balances first (R and K, then J and B), until the motion has told them; then the filter. */
void servo_estimator_start_unknown(servo_estimator *e, const servo_noise *noise, int32_t counts);
#endif
/* One sample, `h` s after the one before. */
void servo_estimator_sample(servo_estimator *e, float h, float voltage, float current, int32_t counts, int valid);
servo_status servo_estimator_status(const servo_estimator *e);
/* A parameter and its standard deviation, SI units. */
float servo_estimator_value(const servo_estimator *e, int parameter);
float servo_estimator_std(const servo_estimator *e, int parameter);
/* Standard deviation of a state: SERVO_CURRENT, SERVO_SPEED, SERVO_ANGLE; of parameters relative. */
float servo_estimator_state_std(const servo_estimator *e, int state);

#endif
