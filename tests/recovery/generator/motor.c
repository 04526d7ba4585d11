/* Equations, modes and integrator of motor.h. */
#include "motor.h"

#include <math.h>
#include <string.h>

#define ALPHA_COPPER 0.0039 /* 1/K at 20 degrees C */
#define BISECTIONS 48       /* of a step of some 10 us: finds the instant to rounding */
#define MOST_EVENTS 100000  /* in one call; a rattling tooth makes a few a millisecond */
/* A held state is left this much above its level, so that rounding cannot end it and start it again for ever. */
#define HOLD (1.0 + 1e-10)

static const double PI = 3.14159265358979323846;

static double wrapped(double angle) { return angle - 2.0 * PI * floor(angle / (2.0 * PI) + 0.5); }

static double motor_constant(const Motor *m, const double *x) {
  const Setup *p = m->p;
  double K = m->now.K;
  if (p->k_rip != 0.0) K *= 1.0 + p->k_rip * sin(p->n_rip * x[ANGLE] + p->phi_rip);
  if (p->I_sat > 0.0) K /= 1.0 + (x[CURRENT] / p->I_sat) * (x[CURRENT] / p->I_sat);
  return K;
}

/* Dry friction when sliding (or about to slide) in a direction. */
static double dry_level(const Motor *m, const double *x, double K, int direction) {
  const Setup *p = m->p;
  double level = direction < 0 ? p->Tc_neg : p->Tc;
  if (p->ws > 0.0) level += (p->Ts - p->Tc) * exp(-(x[SPEED] / p->ws) * (x[SPEED] / p->ws));
  if (p->mu != 0.0) level += p->mu * fabs(K * x[CURRENT]);
  if (p->T_spot != 0.0) {
    double away = wrapped(x[ANGLE] - p->theta_spot) / p->width_spot;
    level += p->T_spot * exp(-0.5 * away * away);
  }
  if (p->Tc_slope != 0.0 || p->Tc_curve != 0.0) {
    level *= 1.0 + x[ANGLE] * (p->Tc_slope + p->Tc_curve * x[ANGLE]);
    if (level < 0.0) level = 0.0;
  }
  return level;
}

/* Smooth torques against the motion that follow the speed alone. */
static double drag(const Motor *m, const double *x) {
  const Setup *p = m->p;
  double w = x[SPEED], against = (p->asymmetric != 0.0 && m->slip < 0 ? p->B_neg : m->now.B) * w;
  if (p->c2 != 0.0) against += p->c2 * w * fabs(w);
  if (p->T_eddy != 0.0) against += 2.0 * p->T_eddy * (w / p->w_eddy) / (1.0 + (w / p->w_eddy) * (w / p->w_eddy));
  if (p->c_root != 0.0) against += p->c_root * w / sqrt(fabs(w) + p->w_root);
  return against;
}

/* Torques against positive motion that follow angle, time and state. */
static double loads(const Motor *m, const double *x, double t) {
  const Setup *p = m->p;
  double a = x[ANGLE], against = m->load;
  if (p->Tg != 0.0) against += p->Tg * sin(a + p->phi_g);
  if (p->Tcog != 0.0) against += p->Tcog * sin(p->n_cog * a + p->phi_cog);
  if (p->Tcog_2 != 0.0) against += p->Tcog_2 * sin(p->n_cog_2 * a + p->phi_cog_2);
  if (p->Tcog_3 != 0.0) against += p->Tcog_3 * sin(p->n_cog_3 * a + p->phi_cog_3);
  if (p->Tper != 0.0) against += p->Tper * sin(2.0 * PI * p->f_per * t + p->phi_per);
  if (p->T_hyst != 0.0) against += p->T_hyst * x[HYSTERESIS];
  if (p->J_l > 0.0) against += motor_spring_torque(m, x);
  return against;
}

/* Force of flank `side` of the gap (0: of a spring without gap); negative where it would have to pull. */
static double flank(const Motor *m, const double *x, int side) {
  const Setup *p = m->p;
  double twist = x[ANGLE] - x[LOAD_ANGLE] - 0.5 * side * p->gap;
  return p->k_s * twist + p->c_s * (x[SPEED] - x[LOAD_SPEED]);
}

double motor_spring_torque(const Motor *m, const double *x) {
  return m->p->gap > 0.0 && m->side == 0 ? 0.0 : flank(m, x, m->side);
}

/* Which flank touches: the teeth have met there, and the force presses. */
static int touching(const Motor *m, const double *x) {
  double twist = x[ANGLE] - x[LOAD_ANGLE], half = 0.5 * m->p->gap;
  if (twist > half && flank(m, x, 1) > 0.0) return 1;
  if (twist < -half && flank(m, x, -1) < 0.0) return -1;
  return 0;
}

/* Everything that accelerates, dry friction aside. */
static double free_torque(const Motor *m, const double *x, double t, double K) {
  return m->now.torque_factor * K * x[CURRENT] - drag(m, x) - loads(m, x, t);
}

/* The direction in which a rotor at rest starts to slide, 0: friction holds it. */
static int breakaway(const Motor *m, const double *x, double t) {
  double K = motor_constant(m, x), torque = free_torque(m, x, t, K);
  int direction = torque < 0.0 ? -1 : 1;
  return fabs(torque) > HOLD * dry_level(m, x, K, direction) ? direction : 0;
}

static double terminal_voltage(const Motor *m, const double *x) { return m->p->t_lag > 0.0 ? x[VOLTAGE] : m->volts; }

/* The direction in which a blocked current starts to flow, 0: the brush drop holds it at zero. */
static int ignition(const Motor *m, const double *x) {
  double drive = terminal_voltage(m, x) - motor_constant(m, x) * x[SPEED];
  if (fabs(drive) <= HOLD * m->drop) return 0;
  return drive < 0.0 ? -1 : 1;
}

/* Acceleration; a mass that joins within a sector of the turn changes the inertia with the angle, and since it gains
   its energy from the rotor the term w^2 dJ/da / 2 belongs to it. */
static double acceleration(const Motor *m, const double *x, double torque) {
  const Setup *p = m->p;
  double away, rise, fall, slope;
  if (p->J_sector == 0.0) return torque / m->now.J;
  away = wrapped(x[ANGLE] - p->theta_sector);
  rise = tanh((away + 0.5 * p->width_sector) / p->edge_sector);
  fall = tanh((away - 0.5 * p->width_sector) / p->edge_sector);
  slope = 0.5 * p->J_sector * (fall * fall - rise * rise) / p->edge_sector;
  return (torque - 0.5 * slope * x[SPEED] * x[SPEED]) / (m->now.J + 0.5 * p->J_sector * (rise - fall));
}

static void rates_of_extras(const Motor *m, const double *x, double R, double *rate) {
  const Setup *p = m->p;
  double loss = R * x[CURRENT] * x[CURRENT];
  rate[LOAD_SPEED] = p->J_l > 0.0 ? motor_spring_torque(m, x) / p->J_l : 0.0;
  rate[LOAD_ANGLE] = x[LOAD_SPEED];
  rate[RISE] = p->C_th > 0.0 ? (loss - x[RISE] / p->R_th) / p->C_th : 0.0;
  rate[VOLTAGE] = p->t_lag > 0.0 ? (m->volts - x[VOLTAGE]) / p->t_lag : 0.0;
  rate[HYSTERESIS] = 0.0;
  if (p->T_hyst != 0.0) rate[HYSTERESIS] = (x[SPEED] - fabs(x[SPEED]) * x[HYSTERESIS]) / p->theta_hyst;
}

static void rates(const Motor *m, const double *x, double t, double *rate) {
  const Setup *p = m->p;
  double K = motor_constant(m, x), R = m->R, L = m->now.L, torque;
  if (p->C_th > 0.0) R *= 1.0 + ALPHA_COPPER * x[RISE];
  if (p->I_L > 0.0) L /= 1.0 + (x[CURRENT] / p->I_L) * (x[CURRENT] / p->I_L);
  rate[CURRENT] = 0.0;
  if (m->drop == 0.0 || m->flow != 0)
    rate[CURRENT] = (terminal_voltage(m, x) - R * x[CURRENT] - K * x[SPEED] - m->flow * m->drop) / L;
  rate[SPEED] = rate[ANGLE] = 0.0;
  if (!m->dry || m->slip != 0) {
    torque = free_torque(m, x, t, K);
    if (m->dry) torque -= m->slip * dry_level(m, x, K, m->slip);
    rate[SPEED] = acceleration(m, x, torque);
    rate[ANGLE] = x[SPEED];
  }
  if (m->states > 3) rates_of_extras(m, x, R, rate);
}

/* Classical Runge-Kutta, fourth order. */
static void step(const Motor *m, double h, double *next) {
  double k1[STATES], k2[STATES], k3[STATES], k4[STATES], mid[STATES];
  const double *x = m->x;
  int j, n = m->states;
  rates(m, x, m->t, k1);
  for (j = 0; j < n; ++j) mid[j] = x[j] + 0.5 * h * k1[j];
  rates(m, mid, m->t + 0.5 * h, k2);
  for (j = 0; j < n; ++j) mid[j] = x[j] + 0.5 * h * k2[j];
  rates(m, mid, m->t + 0.5 * h, k3);
  for (j = 0; j < n; ++j) mid[j] = x[j] + h * k3[j];
  rates(m, mid, m->t + h, k4);
  for (j = 0; j < n; ++j) next[j] = x[j] + h / 6.0 * (k1[j] + 2.0 * (k2[j] + k3[j]) + k4[j]);
}

/* Do the modes still hold in this state? */
static int modes_hold(const Motor *m, const double *x, double t) {
  if (m->dry && (m->slip != 0 ? m->slip * x[SPEED] < 0.0 : breakaway(m, x, t) != 0)) return 0;
  if (m->drop > 0.0 && (m->flow != 0 ? m->flow * x[CURRENT] < 0.0 : ignition(m, x) != 0)) return 0;
  if (m->p->gap > 0.0) return m->side != 0 ? m->side * flank(m, x, m->side) >= 0.0 : touching(m, x) == 0;
  return 1;
}

/* Modes that do not hold in the present state give way to those that do. */
static void switch_modes(Motor *m) {
  if (m->p->gap > 0.0) {
    if (m->side != 0 && m->side * flank(m, m->x, m->side) < 0.0) m->side = 0;
    if (m->side == 0) m->side = touching(m, m->x);
  }
  if (m->drop > 0.0) {
    if (m->flow * m->x[CURRENT] < 0.0) m->x[CURRENT] = 0.0, m->flow = 0;
    if (m->flow == 0) m->flow = ignition(m, m->x);
  }
  if (m->dry) {
    if (m->slip * m->x[SPEED] < 0.0) m->x[SPEED] = 0.0, m->slip = 0;
    if (m->slip == 0) m->slip = breakaway(m, m->x, m->t);
  }
}

/* The first instant of a step at which the modes no longer hold; `next` becomes the state there. */
static double first_event(const Motor *m, double h, double *next) {
  double held = 0.0, ended = h;
  int n;
  for (n = 0; n < BISECTIONS; ++n) {
    double middle = 0.5 * (held + ended);
    step(m, middle, next);
    if (modes_hold(m, next, m->t + middle)) held = middle;
    else ended = middle;
  }
  step(m, ended, next);
  return ended;
}

int motor_advance(Motor *m, double until) {
  double next[STATES], left = until - m->t;
  int events = 0;
  switch_modes(m); /* voltage, load or parameters may just have jumped */
  while (left > 0.0) {
    double h = left / ceil(left / m->p->step_s);
    int holds;
    step(m, h, next);
    holds = modes_hold(m, next, m->t + h);
    if (!holds) h = first_event(m, h, next);
    memcpy(m->x, next, sizeof(double) * (size_t)m->states);
    m->t += h;
    left -= h;
    if (!holds) {
      switch_modes(m);
      if (++events > MOST_EVENTS) return -1;
    }
  }
  m->t = until;
  return 0;
}

double motor_dry_torque(const Motor *m) {
  double K = motor_constant(m, m->x);
  if (!m->dry) return 0.0;
  return m->slip == 0 ? free_torque(m, m->x, m->t, K) : m->slip * dry_level(m, m->x, K, m->slip);
}

void motor_start(Motor *m, const Setup *p) {
  memset(m, 0, sizeof *m);
  m->p = p;
  m->x[CURRENT] = p->start_current;
  m->x[SPEED] = p->start_speed;
  m->x[ANGLE] = p->start_angle;
  m->x[LOAD_SPEED] = p->start_load_speed;
  m->x[LOAD_ANGLE] = p->start_load_angle;
  m->x[RISE] = p->start_rise;
  m->dry = p->Tc > 0.0 || p->Tc_neg > 0.0 || p->Ts > 0.0 || p->mu != 0.0 || p->T_spot != 0.0 ||
           p->asymmetric != 0.0;
  m->slip = (p->start_speed > 0.0) - (p->start_speed < 0.0);
  m->flow = (p->start_current > 0.0) - (p->start_current < 0.0);
  m->states = p->J_l > 0.0 || p->C_th > 0.0 || p->t_lag > 0.0 || p->T_hyst != 0.0 ? STATES : 3;
}
