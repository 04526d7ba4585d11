/* A DC servo motor with its real-life faults, for tests that hide an effect. Written on its own: nothing here is taken
   from servo_daemon's plant, so that a model that is fitted to these data never meets itself.

   Equations (SI units; s the direction of sliding, K' and L' the constants as they are at this current and angle):

     L' di/dt = v - R' i - K' w - Vb sgn i        K' = K (1 + k_rip sin(n_rip a + phi_rip)) / (1 + (i/I_sat)^2)
     J' dw/dt = f K' i - B w - s T_dry - (loads)  R' = (R + dR [t >= t_R]) (1 + 0.0039 rise)
        da/dt = w                                 v follows the command with the lag t_lag

   `sgn` is exact: at speed zero the rotor sticks until the other torques exceed the breakaway level; at current zero
   the brushes block until the voltage exceeds Vb; the teeth of a backlash push and never pull. Each of these is a mode
   that is frozen during an integration step; the instant at which it ends is found by bisection. */
#ifndef MOTOR_H
#define MOTOR_H

/* One list for the struct, for the names that Python reads, and so for the layout that both share. */
#define SETUP_FIELDS(X)                                                                                              \
  X(step_s)                                                                                                          \
  /* state at the first sample */                                                                                    \
  X(start_current) X(start_speed) X(start_angle) X(start_load_speed) X(start_load_angle) X(start_rise)               \
  /* friction; Tc_neg and B_neg are always set, equal to the positive side where friction is symmetric */            \
  X(Tc) X(Tc_neg) X(asymmetric) X(B_neg) X(Ts) X(ws) X(Tc_slope) X(Tc_curve) X(mu) X(c2)                             \
  /* loads */                                                                                                        \
  X(Tg) X(phi_g) X(Tcog) X(n_cog) X(phi_cog) X(Tcog_2) X(n_cog_2) X(phi_cog_2) X(Tcog_3) X(n_cog_3) X(phi_cog_3)     \
  X(dTL) X(t_TL) X(Tper) X(f_per) X(phi_per)                                                                         \
  /* motor */                                                                                                        \
  X(k_rip) X(n_rip) X(phi_rip) X(Vb) X(I_sat) X(R_th) X(C_th) X(dR) X(t_R) X(t_lag)\
  /* the bridge is open where the command is zero */ X(freewheel)                                  \
  /* second inertia, on the far side of gap, spring and damper */                                                    \
  X(gap) X(k_s) X(c_s) X(J_l)                                                                                        \
  /* sensors that the control loop sees as well */                                                                   \
  X(e_enc) X(phi_enc) X(counts_per_rev) X(t_d) X(delayed_channel)                                                    \
  /* causes that servo_daemon has no name for */                                                                     \
  X(J_sector) X(theta_sector) X(width_sector) X(edge_sector) X(T_hyst) X(theta_hyst) X(c_root) X(w_root)             \
  X(T_eddy) X(w_eddy) X(T_spot) X(theta_spot) X(width_spot) X(I_L)                                                   \
  /* drive: mode 0 the reference is the voltage, 1 speed, 2 position */                                              \
  X(mode) X(kp) X(ki) X(k_pos) X(filter_s) X(speed_limit) X(supply_V) X(current_limit) X(R_nominal) X(L_nominal)     \
  /* voltage within a sample interval: pieces of hidden noise, PWM periods (0: a constant voltage) */                \
  X(noise_pieces) X(pwm_periods)

/* Columns of the input, one row a sample; held until the next sample. */
#define INPUT_FIELDS(X) X(time) X(R) X(L) X(K) X(J) X(B) X(TL) X(torque_factor) X(reference) X(added_voltage)

/* Columns of the output, one row a sample: what drive and sensors know, then the truth at that instant. `applied` is
   the mean voltage at the terminals until the next sample; `slip` is -1, 0 (sticks) or 1. */
#define OUTPUT_FIELDS(X)                                                                                             \
  X(command) X(shown_current) X(shown_angle) X(current) X(speed) X(angle) X(load_speed) X(load_angle) X(rise)        \
  X(applied) X(slip) X(dry_torque) X(spring_torque)

#define FIELD(name) double name;
typedef struct { SETUP_FIELDS(FIELD) } Setup;
typedef struct { INPUT_FIELDS(FIELD) } Input;
typedef struct { OUTPUT_FIELDS(FIELD) } Output;
#undef FIELD

enum { CURRENT, SPEED, ANGLE, LOAD_SPEED, LOAD_ANGLE, RISE, VOLTAGE, HYSTERESIS, STATES };
enum { NO_CHANNEL, CURRENT_CHANNEL, POSITION_CHANNEL };

typedef struct {
  const Setup *p;
  Input now;       /* parameters of this sample interval */
  double R, load;  /* R and load torque after their steps */
  double drop;     /* blocks the current: of the brushes, of the diodes of an open bridge */
  double volts;    /* at the terminals (with t_lag: what they follow) */
  double t, x[STATES];
  int slip;        /* direction of sliding, 0: sticks */
  int flow;        /* direction of the current, 0: blocked by the brushes */
  int side;        /* tooth flank in contact, 0: within the gap */
  int dry, states; /* is there anything that depends on the sign of the speed; how many states are in use */
} Motor;

void motor_start(Motor *m, const Setup *p);
/* To time `until` with everything held. 0, or -1 if events never end. */
int motor_advance(Motor *m, double until);
double motor_dry_torque(const Motor *m);
double motor_spring_torque(const Motor *m, const double *x);

#endif
