@HEADER@
/* servo_estimator.c - see servo_estimator.h.
 *
 * An extended Kalman filter of current, speed, angle and @N@ parameters with the motor's own step (generated below from
 * servo-daemon's equations; @OPERATIONS@ operations), its covariance as U D U' (Bierman, Factorization Methods for
 * Discrete Sequential Estimation, 1977: chapters V and VI; the parameters stand last, so that only the 3 x 3 block of
 * the states is factored anew in a step). It does in single precision what the daemon's filter does in double.
 *
 * Memory: @MEMORY@
 * Time: @TIME@
 * SPDX-License-Identifier: Apache-2.0
 */
#include "servo_estimator.h"

#include <math.h>
#include <string.h>

#define GATE 5.0f             /* standard deviations at which an innovation is weighted down */
#define TRAJECTORY_S 0.1f     /* the instrumental trajectory follows the filter this slowly */
#define YOUTH 0.1f            /* ... and at most by this share of its age */
#define SAMPLES_TO_FIND_SPEED 3.0f
#define TO_SLIDE 0.25f        /* of the speed's standard deviation; see the daemon's kalman/model.py */
#define SERVO_KNOWN 0.05f     /* relative standard deviation below which a parameter is known */
#define SAMPLES_TO_TRUST 10u  /* after a start */
#define DOUBTFUL_SHARE 0.1f   /* of outliers among the last samples */
#define MEMORY 0.005f         /* the last 200 samples */
#define LARGE 2.0f            /* mean square of what should have 1 */
#define COLOURED 0.3f         /* correlation of neighbours: white noise has 0.05 over so many */
#define REBASE_RAD 8.0f       /* single precision keeps 1e-6 rad below this */
#define WINDOW 16u            /* samples of a least-squares equation */
#define START_KNOWN 0.1f      /* relative standard deviation at which least squares hands over */
#define START_ROUGH 0.3f      /* ... and beyond which it says nothing */
#define START_LEAST_STD 0.1f  /* what the filter believes of a value from least squares, at the least */
#define UNKNOWN_STD {100.0f, 1000.0f, 100.0f}

enum { N = SERVO_STATES, NP = SERVO_PARAMETERS };

static inline float servo_max(float a, float b) { return a > b ? a : b; }
@HELPERS@static inline float servo_abs(float a) { return a < 0.0f ? -a : a; }

const char servo_parameter_names[SERVO_PARAMETERS][8] = {@QUOTED@};
/* Exported values, their standard deviation (relative; of TL in N m; 0: not known), bounds and kind. */
static const float EXPORTED[NP] = {@VALUES@};
static const float EXPORTED_STD[NP] = {@STDS@};
static const float LOWEST[NP] = {@LOWEST@};
static const float HIGHEST[NP] = {@HIGHEST@};
static const uint8_t SIGNED[NP] = {@SIGNED@};

/* x and trajectory after h; derivatives by current and speed at `away` (3 x 2), by the parameters at `trajectory`
 * (3 x NP), and by voltage and load torque (3 x 2). */
static void motor_step(const float *x, const float *xi, const float *away, const float *p, float u, float h,
                       float *xn, float *xin, float *fx, float *fq, float *g) {
    (void)away;
@STEP@
}

/* P + c e_k e_k' (Agee & Turner; Bierman, table III.1). */
static void add_variance(servo_estimator *e, int k, float c) {
    float a[N];
    for (int i = 0; i < k; i++) a[i] = 0.0f;
    a[k] = 1.0f;
    for (int j = k; j > 0 && c > 0.0f; j--) {
        const float d = e->D[j] + c * a[j] * a[j], b = c * a[j] / d;
        c *= e->D[j] / d;
        e->D[j] = d;
        for (int i = 0; i < j; i++) {
            a[i] -= a[j] * e->U[i][j];
            e->U[i][j] += b * a[i];
        }
    }
    if (k == 0 || c > 0.0f) e->D[0] += c * a[0] * a[0];
}

static float variance(const servo_estimator *e, int k) {
    float sum = e->D[k];
    for (int j = k + 1; j < N; j++) sum += e->U[k][j] * e->U[k][j] * e->D[j];
    return sum;
}

/* A start whose covariance is diagonal. */
static void set_variance(servo_estimator *e, int k, float var) {
    for (int j = k + 1; j < N; j++) e->U[k][j] = 0.0f;
    for (int i = 0; i < k; i++) e->U[i][k] = 0.0f;
    e->U[k][k] = 1.0f;
    e->D[k] = var;
}

static void put_parameter(servo_estimator *e, int k) {
    float moved = e->moved[k];
    float value = SIGNED[k] ? e->start[k] + moved : e->start[k] * expf(moved);
    if (!(value >= LOWEST[k]) || value > HIGHEST[k]) {
        value = value > HIGHEST[k] ? HIGHEST[k] : LOWEST[k];
        e->moved[k] = SIGNED[k] ? value - e->start[k] : logf(value / e->start[k]);
    }
    e->p[k] = value;
}

static void time_update(servo_estimator *e, float h) {
    float xn[3], xin[3], fx[6], fq[3 * NP], g[6], away[3], W[3][5], w[5], column[N];
    const float var_u = e->noise.voltage_std * e->noise.voltage_std;
    memcpy(away, e->x, sizeof away);
@AWAY@
    motor_step(e->x, e->trajectory, away, e->p, e->voltage, h, xn, xin, fx, fq, g);
    const float found = e->age_s >= (SAMPLES_TO_FIND_SPEED - 0.5f) * h ? 1.0f : 0.0f;

    /* Columns of the parameters: Fxx Uxq + Fxq Uqq; those of the parameters themselves stay. */
    for (int j = 3; j < N; j++) {
        for (int i = 0; i < 3; i++) {
            float sum = 0.0f;
            for (int k = 3; k < j; k++) sum += fq[i * NP + k - 3] * e->U[k][j];
            sum = found * (sum + fq[i * NP + j - 3]);
            column[i] = sum + fx[2 * i] * e->U[0][j] + fx[2 * i + 1] * e->U[1][j];
        }
        column[2] += e->U[2][j];
        for (int i = 0; i < 3; i++) e->U[i][j] = column[i];
    }
    /* The states' own block: modified weighted Gram-Schmidt of (Fxx Uxx | noise) (Bierman, section VI.4). */
    for (int i = 0; i < 3; i++) {
        const float theta = i == 2 ? 1.0f : 0.0f;
        W[i][0] = fx[2 * i];
        W[i][1] = fx[2 * i] * e->U[0][1] + fx[2 * i + 1];
        W[i][2] = fx[2 * i] * e->U[0][2] + fx[2 * i + 1] * e->U[1][2] + theta;
        W[i][3] = g[2 * i];
        W[i][4] = g[2 * i + 1];
    }
    w[0] = e->D[0]; w[1] = e->D[1]; w[2] = e->D[2]; w[3] = var_u; w[4] = e->noise.torque_density / h;
    for (int j = 2; j >= 0; j--) {
        float d = 0.0f;
        for (int k = 0; k < 5; k++) d += w[k] * W[j][k] * W[j][k];
        e->D[j] = d;
        for (int i = 0; i < j; i++) {
            float sum = 0.0f;
            for (int k = 0; k < 5; k++) sum += w[k] * W[i][k] * W[j][k];
            const float u = d > 0.0f ? sum / d : 0.0f;
            e->U[i][j] = u;
            for (int k = 0; k < 5; k++) W[i][k] -= u * W[j][k];
        }
    }
    /* One parameter a step may have walked, by as much as all steps since its last turn. */
    const int k = e->walks;
    if (e->noise.walk[k] > 0.0f) add_variance(e, 3 + k, e->noise.walk[k] * h * (float)NP);
    e->walks = (uint8_t)((k + 1) % NP);
    memcpy(e->x, xn, sizeof xn);
    memcpy(e->trajectory, xin, sizeof xin);
}

/* A scalar measurement of state m (Bierman, section V.3). Returns whether it was an outlier. */
static int measure(servo_estimator *e, int m, float y, float r) {
    float v[N], b[N], s = r, move[N];
    for (int j = m; j < N; j++) {
        v[j] = e->D[j] * (j == m ? 1.0f : e->U[m][j]);
        s += v[j] * (j == m ? 1.0f : e->U[m][j]);
    }
    const float innovation = y - e->x[m];
    if (m == SERVO_CURRENT && e->samples >= SAMPLES_TO_TRUST) {
        const float size = servo_abs(innovation) < GATE * sqrtf(s) ? innovation / sqrtf(s) : 0.0f;
        e->nis += MEMORY * (size * size - e->nis);
        e->lagged += MEMORY * (size * e->last - e->lagged);
        e->last = size;
    }
    const float extra = innovation * innovation / (GATE * GATE) - s;
    const int outlier = extra > 0.0f;
    if (outlier) { /* half of it was the sensor, half the motor */
        add_variance(e, m, 0.5f * extra);
        r += 0.5f * extra;
        for (int j = m; j < N; j++) v[j] = e->D[j] * (j == m ? 1.0f : e->U[m][j]);
    }
    float alpha = r;
    for (int j = 0; j < m; j++) b[j] = 0.0f;
    for (int j = m; j < N; j++) {
        const float f = j == m ? 1.0f : e->U[m][j], before = alpha, p = -f / before;
        alpha += v[j] * f;
        e->D[j] *= before / alpha;
        b[j] = v[j];
        for (int i = 0; i < j; i++) {
            const float t = e->U[i][j];
            e->U[i][j] = t + b[i] * p;
            b[i] += t * v[j];
        }
    }
    const float k = innovation / alpha;
    for (int i = 0; i < N; i++) move[i] = b[i] * k;
    for (int i = 0; i < 3; i++) e->x[i] += move[i];
    for (int i = 0; i < NP; i++) e->moved[i] += move[3 + i];
    return outlier;
}

/* What is left of the trajectory's distance from the filter after h. */
static float slowness(servo_estimator *e, float h) {
    const float young = YOUTH * (e->age_s + h);
    if (young < TRAJECTORY_S) return expf(-h / young);
    if (h != e->slow_h) { /* the same in every sample of a regular drive */
        e->slow_h = h;
        e->slow = expf(-h / TRAJECTORY_S);
    }
    return e->slow;
}

static void rebase(servo_estimator *e, int32_t counts) {
    /* Modulo 2^32 and by whole counts, so that nothing is rounded. */
    const int32_t away = (int32_t)((uint32_t)counts - (uint32_t)e->base_counts);
    const float by = SERVO_RAD_PER_COUNT * (float)away;
    if (servo_abs(by) < REBASE_RAD) return;
    e->base_counts = counts;
    e->x[2] -= by;
    e->trajectory[2] -= by;
}

static void begin(servo_estimator *e, const float *values, const float *std, int32_t counts) {
    static const float unknown[3] = UNKNOWN_STD;
    memcpy(e->start, values, sizeof e->start);
    for (int k = 0; k < N; k++) set_variance(e, k, k < 3 ? unknown[k] * unknown[k] : std[k - 3] * std[k - 3]);
    for (int k = 0; k < NP; k++) {
        e->moved[k] = 0.0f;
        put_parameter(e, k);
    }
    for (int k = 0; k < 3; k++) e->x[k] = e->trajectory[k] = 0.0f;
    e->age_s = e->outliers = e->lagged = e->last = 0.0f;
    e->nis = 1.0f;
    e->walks = 0;
    e->base_counts = counts;
    e->leaning = 0;
    e->samples = 0;
}

static void exported_std(float wider, float *std) {
    for (int k = 0; k < NP; k++) {
        const float otherwise = SIGNED[k] ? 0.1f * servo_abs(EXPORTED[k]) : 0.1f;
        std[k] = EXPORTED_STD[k] > 0.0f ? wider * EXPORTED_STD[k] : otherwise;
    }
}

void servo_estimator_start_at(servo_estimator *e, const servo_noise *noise, int32_t counts, const float *values,
                              const float *std) {
    memset(e, 0, sizeof *e);
    e->noise = *noise;
    begin(e, values, std, counts);
}

void servo_estimator_start(servo_estimator *e, const servo_noise *noise, int32_t counts, float wider) {
    float std[NP];
    exported_std(wider, std);
    servo_estimator_start_at(e, noise, counts, EXPORTED, std);
    e->start_std = wider;
}

#if SERVO_LINEAR
void servo_estimator_start_unknown(servo_estimator *e, const servo_noise *noise, int32_t counts) {
    servo_estimator_start(e, noise, counts, 3.0f);
    e->leaning = 1;
}

/* y = a x + b z from the sums (xx, xz, zz, xy, zy), and the relative standard deviations of a and b under an error of
 * the equation with variance `var`. Returns 0 where the motion does not tell them apart or a is not positive. */
static int solve(const float *s, float var, float *a, float *b, float *std_a, float *std_b) {
    const float det = s[0] * s[2] - s[1] * s[1];
    if (!(det > 1e-4f * s[0] * s[2])) return 0;
    *a = (s[2] * s[3] - s[1] * s[4]) / det;
    *b = (s[0] * s[4] - s[1] * s[3]) / det;
    if (!(*a > 0.0f)) return 0;
    *std_a = sqrtf(var * s[2] / det) / *a;
    *std_b = *b > 0.0f ? sqrtf(var * s[0] / det) / *b : INFINITY;
    return 1;
}

static void add(float *s, float x, float z, float y) {
    s[0] += x * x; s[1] += x * z; s[2] += z * z; s[3] += x * y; s[4] += z * y;
}

/* One sample of the start by least squares, from the two balances integrated over WINDOW samples:
 *     int v - L di = R int i + K dtheta        K int i = J domega + B dtheta
 * Forgets nothing: it lasts as long as the motion needs to tell the four. */
static void least_squares(servo_estimator *e, float h, float voltage, float current, int32_t counts) {
    const float theta = SERVO_RAD_PER_COUNT * (float)(int32_t)((uint32_t)counts - (uint32_t)e->base_counts);
    const uint32_t k = e->samples++;
    if (k > 0) {
        e->w_i += 0.5f * h * (current + e->last_i);
        e->w_v += h * e->voltage;
        e->w_t += h;
        e->in_window++;
    }
    if (k == 1) { /* the first window */
        e->w_theta = e->last_theta;
        e->w_i0 = e->last_i;
        e->w_omega = (theta - e->last_theta) / h;
    } else if (k > 1 && e->in_window >= WINDOW) {
        const float omega = (theta - e->last_theta) / h, dtheta = theta - e->w_theta;
        float R, K, J, B, std[4];
        add(e->see, e->w_i, dtheta, e->w_v - SERVO_L * (current - e->w_i0));
        add(e->smm, omega - e->w_omega, dtheta, e->w_i);
        const float T = e->w_t, n = (float)WINDOW;
        const float var_e = T * T * e->noise.voltage_std * e->noise.voltage_std / n +
                            EXPORTED[SERVO_R] * EXPORTED[SERVO_R] * T * T * e->noise.current_std * e->noise.current_std / n +
                            2.0f * SERVO_L * SERVO_L * e->noise.current_std * e->noise.current_std;
        if (solve(e->see, var_e, &R, &K, &std[0], &std[1]) && servo_max(std[0], std[1]) < START_KNOWN &&
            solve(e->smm, e->noise.current_std * e->noise.current_std * T * T / n +
                              4.0f * EXPORTED[SERVO_J] * EXPORTED[SERVO_J] / (K * K) * e->noise.position_std *
                                  e->noise.position_std / (h * h),
                  &J, &B, &std[2], &std[3]) &&
            std[2] < START_KNOWN) {
            float values[NP], stds[NP];
            memcpy(values, EXPORTED, sizeof values);
            exported_std(3.0f, stds);
            const float found[4] = {R, K, K * J, K * B}; /* the second balance was divided by K */
            for (int j = 0; j < 4; j++) {
                if (!(std[j] < START_ROUGH)) { /* friction too faint to be told: as exported, and not believed */
                    stds[j] = servo_max(stds[j], 1.0f);
                    continue;
                }
                values[j] = found[j];
                stds[j] = servo_max(3.0f * std[j], START_LEAST_STD);
            }
            begin(e, values, stds, counts);
            e->voltage = voltage;
            return;
        }
        e->in_window = 0;
        e->w_i = e->w_v = e->w_t = 0.0f;
        e->w_theta = theta;
        e->w_i0 = current;
        e->w_omega = omega;
    }
    e->last_i = current;
    e->last_theta = theta;
}
#endif

void servo_estimator_sample(servo_estimator *e, float h, float voltage, float current, int32_t counts, int valid) {
    int outlier = 0;
    h = servo_max(h, 1e-6f);
#if SERVO_LINEAR
    if (e->leaning) {
        if (valid == SERVO_ALL_VALID) least_squares(e, h, voltage, current, counts);
        e->voltage = voltage;
        return;
    }
#endif
    time_update(e, h);
    const float modelled[2] = {e->trajectory[0], e->trajectory[1]};
    if (valid & SERVO_CURRENT_VALID)
        outlier |= measure(e, SERVO_CURRENT, current, e->noise.current_std * e->noise.current_std);
    if (valid & SERVO_POSITION_VALID) {
        const float y = SERVO_RAD_PER_COUNT * (float)(int32_t)((uint32_t)counts - (uint32_t)e->base_counts);
        outlier |= measure(e, SERVO_ANGLE, y, e->noise.position_std * e->noise.position_std);
    }
    for (int k = 0; k < NP; k++) put_parameter(e, k);
    const float slow = slowness(e, h);
    for (int i = 0; i < 2; i++) e->trajectory[i] = e->x[i] + slow * (modelled[i] - e->x[i]);
    e->trajectory[2] = e->x[2];
    e->age_s = outlier ? SAMPLES_TO_FIND_SPEED * h : e->age_s < 1e4f ? e->age_s + h : e->age_s;
    e->outliers += MEMORY * ((outlier ? 1.0f : 0.0f) - e->outliers);
    e->voltage = voltage;
    e->samples++;
    if (valid & SERVO_POSITION_VALID) rebase(e, counts);
    /* A sum that is no number says that something in it is none. */
    float sum = e->x[0] + e->x[1] + e->x[2];
    for (int k = 0; k < N; k++) sum += e->D[k] >= 0.0f ? e->D[k] : NAN;
    for (int k = 0; k < NP; k++) sum += e->moved[k];
    if (!(servo_abs(sum) < 1e30f)) {
        float std[NP];
        exported_std(e->start_std > 0.0f ? e->start_std : 3.0f, std);
        begin(e, EXPORTED, std, counts);
        e->broken = 1;
    } else if (e->samples == SAMPLES_TO_TRUST) {
        e->broken = 0;
    }
}

servo_status servo_estimator_status(const servo_estimator *e) {
    if (e->leaning || e->samples < SAMPLES_TO_TRUST) return e->broken ? SERVO_INVALID : SERVO_STARTING;
    if (e->outliers > DOUBTFUL_SHARE || e->nis > LARGE || servo_abs(e->lagged) > COLOURED * servo_max(e->nis, 1.0f))
        return SERVO_DOUBTFUL;
    for (int k = 0; k < NP; k++)
        if (!SIGNED[k] && !(variance(e, 3 + k) < SERVO_KNOWN * SERVO_KNOWN)) return SERVO_ESTIMATING;
    return SERVO_TRACKING;
}

float servo_estimator_value(const servo_estimator *e, int parameter) { return e->p[parameter]; }

float servo_estimator_std(const servo_estimator *e, int parameter) {
    const float std = sqrtf(variance(e, 3 + parameter));
    return SIGNED[parameter] ? std : std * e->p[parameter];
}

float servo_estimator_state_std(const servo_estimator *e, int state) { return sqrtf(variance(e, state)); }
