/* The drive around the motor: sampling instants, control loop, encoder, and the voltage within a sample interval. */
#include <math.h>
#include <string.h>

#include "motor.h"

#define NAME(field) #field " "
const char *setup_fields(void) { return SETUP_FIELDS(NAME); }
const char *input_fields(void) { return INPUT_FIELDS(NAME); }
const char *output_fields(void) { return OUTPUT_FIELDS(NAME); }
#undef NAME

typedef struct {
  double position, speed, error, integral, time, current, volts;
} Controller;

typedef struct {
  const Setup *p;
  const Input *in;
  const double *noise; /* hidden voltage, noise_pieces a sample, or null */
  Output *out;
  long n, read;        /* samples; how many readings of the delayed channel have been taken */
  Motor motor;
} Run;

static double clip(double value, double lower, double upper) {
  return value < lower ? lower : value > upper ? upper : value;
}

static double shown_angle(const Setup *p, double angle) {
  double shown = angle + p->e_enc * sin(angle + p->phi_enc);
  double turn = 2.0 * 3.14159265358979323846;
  if (p->counts_per_rev <= 0.0) return shown;
  return floor(shown * p->counts_per_rev / turn) * turn / p->counts_per_rev;
}

/* The late channel shows sample `read` what the motor was t_d before. */
static void take_late_readings(Run *r) {
  const Setup *p = r->p;
  while (r->read < r->n && r->in[r->read].time - p->t_d <= r->motor.t) {
    Output *o = &r->out[r->read++];
    if (p->delayed_channel == CURRENT_CHANNEL) o->shown_current = r->motor.x[CURRENT];
    else o->shown_angle = shown_angle(p, r->motor.x[ANGLE]);
  }
}

/* Load and resistance after their steps, from the present instant on. */
static void hold_steps(Run *r) {
  Motor *m = &r->motor;
  m->load = m->now.TL + (m->t >= r->p->t_TL ? r->p->dTL : 0.0);
  m->R = m->now.R + (m->t >= r->p->t_R ? r->p->dR : 0.0);
}

/* Advances with one voltage, stopping where a step of load or resistance or a late reading falls in between. */
static int advance(Run *r, double until) {
  const Setup *p = r->p;
  Motor *m = &r->motor;
  while (m->t < until) {
    double next = until;
    if (p->t_TL > m->t && p->t_TL < next) next = p->t_TL;
    if (p->t_R > m->t && p->t_R < next) next = p->t_R;
    if (p->delayed_channel != NO_CHANNEL && r->read < r->n && r->in[r->read].time - p->t_d < next)
      next = r->in[r->read].time - p->t_d;
    hold_steps(r);
    if (motor_advance(m, next)) return -1;
    if (p->delayed_channel != NO_CHANNEL) take_late_readings(r);
  }
  return 0;
}

/* One PWM period, centre-aligned and bipolar: a current sampled at its edges is the mean current. */
static int pwm_period(Run *r, double from, double until, double volts, double noise) {
  double supply = r->p->supply_V, length = until - from;
  double low = 0.5 * (1.0 - clip(volts / supply, -1.0, 1.0)) * length;
  r->motor.volts = noise - supply;
  if (advance(r, from + 0.5 * low)) return -1;
  r->motor.volts = noise + supply;
  if (advance(r, until - 0.5 * low)) return -1;
  r->motor.volts = noise - supply;
  return advance(r, until);
}

/* From sample k to the next under the voltage `volts`; the mean of what was applied goes to the output. */
static int interval(Run *r, long k, double volts) {
  const Setup *p = r->p;
  double from = r->in[k].time, length = r->in[k + 1].time - from, mean = 0.0, lagged = r->motor.x[VOLTAGE];
  int open = p->freewheel > 0.0 && volts == 0.0;
  int periods = open ? 0 : (int)p->pwm_periods, pieces = (int)p->noise_pieces, j;
  int parts = periods > pieces ? periods : pieces;
  r->motor.drop = p->Vb + (open ? p->supply_V : 0.0);
  if (r->motor.drop > 0.0 && r->motor.flow == 0)
    r->motor.flow = (r->motor.x[CURRENT] > 0.0) - (r->motor.x[CURRENT] < 0.0);
  for (j = 0; j < parts; ++j) {
    double noise = r->noise && !open ? r->noise[k * pieces + (long)j * pieces / parts] : 0.0;
    double until = j + 1 == parts ? r->in[k + 1].time : from + length * (j + 1) / parts;
    mean += (volts + noise) / parts;
    r->motor.volts = volts + noise;
    if (periods ? pwm_period(r, r->motor.t, until, volts, noise) : advance(r, until)) return -1;
  }
  if (p->t_lag > 0.0) mean -= p->t_lag * (r->motor.x[VOLTAGE] - lagged) / length;
  r->out[k].applied = mean;
  return 0;
}

/* The drive's current limit: the voltage that keeps the next sample's current within it, by the nominal winding and the
   back-EMF of the interval just past. It works from the drive's own current sensor, whatever the capture shows. */
static double limited(const Setup *p, const Controller *c, double dt, double current, double volts) {
  double decay = exp(-dt * p->R_nominal / p->L_nominal), admittance = (1.0 - decay) / p->R_nominal;
  double emf = c->volts - (current - decay * c->current) / admittance;
  volts = clip(volts, emf + (-p->current_limit - decay * current) / admittance,
               emf + (p->current_limit - decay * current) / admittance);
  return clip(volts, -p->supply_V, p->supply_V);
}

/* Speed from encoder differences, then PI; around it a P loop for the position. */
static double wanted_voltage(const Setup *p, Controller *c, const Input *in, double dt, double position, int first) {
  double target = in->reference;
  if (p->mode == 0.0) return in->reference + in->added_voltage;
  if (!first) c->speed += ((position - c->position) / dt - c->speed) * (1.0 - exp(-dt / p->filter_s));
  if (p->mode == 2.0) target = p->k_pos * (in->reference - position);
  target = clip(target, -p->speed_limit, p->speed_limit);
  c->error = target - c->speed;
  return p->kp * c->error + c->integral + in->added_voltage;
}

static double control(const Setup *p, Controller *c, const Input *in, double position, double current, int first) {
  double dt = in->time - c->time, wanted = wanted_voltage(p, c, in, dt, position, first);
  double volts = limited(p, c, dt, current, wanted);
  /* no wind-up against a limit */
  if (!first && (wanted - volts) * c->error <= 0.0) c->integral += p->ki * c->error * dt;
  c->position = position;
  c->time = in->time;
  c->current = current;
  c->volts = volts;
  return volts;
}

static void record_truth(const Motor *m, Output *o) {
  o->current = m->x[CURRENT];
  o->speed = m->x[SPEED];
  o->angle = m->x[ANGLE];
  o->load_speed = m->x[LOAD_SPEED];
  o->load_angle = m->x[LOAD_ANGLE];
  o->rise = m->x[RISE];
  o->slip = m->dry ? m->slip : (m->x[SPEED] > 0.0) - (m->x[SPEED] < 0.0);
  o->dry_torque = motor_dry_torque(m);
  o->spring_torque = m->p->J_l > 0.0 ? motor_spring_torque(m, m->x) : 0.0;
}

/* n samples. `noise` is null or has n * noise_pieces values. 0, or the number of the sample that could not be reached. */
long generate(long n, const double *setup, const double *input, const double *noise, double *output) {
  Run r = {(const Setup *)setup, (const Input *)input, noise, (Output *)output, n, 0, {0}};
  Controller controller = {0}; /* one period ago, at the voltage that held the motor in its first state */
  long k;
  motor_start(&r.motor, r.p);
  r.motor.t = r.in[0].time;
  controller.time = 2.0 * r.in[0].time - r.in[1].time;
  controller.current = r.p->start_current;
  controller.volts = r.in[0].R * r.p->start_current + r.in[0].K * r.p->start_speed;
  for (k = 0; k < n; ++k) {
    Output *o = &r.out[k];
    if (r.p->delayed_channel != NO_CHANNEL) take_late_readings(&r);
    if (r.p->delayed_channel != CURRENT_CHANNEL) o->shown_current = r.motor.x[CURRENT];
    if (r.p->delayed_channel != POSITION_CHANNEL) o->shown_angle = shown_angle(r.p, r.motor.x[ANGLE]);
    o->command = control(r.p, &controller, &r.in[k], o->shown_angle, r.motor.x[CURRENT], k == 0);
    r.motor.now = r.in[k];
    hold_steps(&r);
    record_truth(&r.motor, o);
    o->applied = o->command;
    if (k + 1 < n && interval(&r, k, o->command)) return k + 1;
  }
  return 0;
}
