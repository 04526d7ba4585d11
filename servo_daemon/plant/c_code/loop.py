"""The loop around a step: n samples through it, the state carried along, for one run or many."""

from __future__ import annotations

import re

ONCE = """
#include <math.h>
#include <string.h>
/* Both sides of a case distinction are computed, the one that does not apply of constants: a function of the same
   argument as in the sample before is not computed again. Each place in the code has its own memory, behind `w`. */
static inline int sd_same(const double* one, const double* other) { return !memcmp(one, other, sizeof *one); }
#define SD_ONCE(f, x) ({ \
  double* m_ = w + SD_W + 1 + 3 * __COUNTER__; const double x_ = (x); \
  if (!sd_same(m_, &x_)) { m_[0] = x_; m_[2] = (f)(x_); } \
  m_[2]; })
#define SD_ONCE_2(f, x, y) ({ \
  double* m_ = w + SD_W + 1 + 3 * __COUNTER__; const double x_ = (x), y_ = (y); \
  if (!sd_same(m_, &x_) || !sd_same(m_ + 1, &y_)) { m_[0] = x_; m_[1] = y_; m_[2] = (f)(x_, y_); } \
  m_[2]; })
"""
#: A statement of generated code that calls a function of the library: the others are single operations.
_CALL = re.compile(r"=(exp|log|sin|cos|tanh|atanh|atan2|casadi_expm1)\(([^()]*)\);")
LOOP = """
#include <stdlib.h>
/* Appended by servo_daemon to the code of a step: n samples through it, the state carried along. */

/* What was prepared for the lengths of step met so far in a call: a table of sets of two, by the length's bits. */
typedef struct {
  double* entries; /* the bits of a length, plus one (0: empty), and what was prepared for it */
  int shift;
  double* w; /* what a step works with */
} sd_table;

#if SD_PREPARED
#define SD_ENTRY (SD_PREPARED + 1)
/* So many lengths at most: a recording has one, a few hundred where its clock shows jitter; and so much memory. */
#define SD_MOST_BITS 12
#define SD_MOST_BYTES (4 << 20)

static int sd_begin(sd_table* table, long long samples) {
  int bits = 1;
  while (bits < SD_MOST_BITS && (1LL << bits) < 2 * samples && (2LL << bits) * SD_ENTRY * 8 <= SD_MOST_BYTES) ++bits;
  table->shift = 64 - bits;
  table->entries = calloc((size_t)SD_ENTRY << bits, sizeof(double));
  return !table->entries;
}

static void sd_end(sd_table* table) { free(table->entries); }

static void sd_forget(sd_table* table) { memset(table->entries, 0, sizeof(double) * SD_ENTRY << (64 - table->shift)); }

static unsigned long long sd_key(const double* entry) {
  unsigned long long key;
  memcpy(&key, entry, sizeof key);
  return key;
}

static const double* sd_prepared(sd_table* table, const double* constants, const double* length) {
  const unsigned long long key = sd_key(length) + 1;
  const unsigned long long place = (key * 0x9E3779B97F4A7C15ULL) >> table->shift; /* Knuth's multiplicative hash */
  double* entry = table->entries + place * SD_ENTRY;
  double* other = table->entries + (place ^ 1) * SD_ENTRY;
  casadi_int iw[SD_IW + 1];
  const double* arg[SD_ARG + 2];
  double* res[SD_RES + 1];
  if (key && sd_key(entry) == key) return entry + 1;
  if (key && sd_key(other) == key) return other + 1;
  if (sd_key(entry) && !sd_key(other)) entry = other;
  memcpy(entry, &key, sizeof key);
  arg[0] = constants; arg[1] = length;
  res[0] = entry + 1;
  prepare(arg, res, iw, table->w, 0);
  return entry + 1;
}
#else
static int sd_begin(sd_table* table, long long samples) { return 0; }
static void sd_end(sd_table* table) {}
static void sd_forget(sd_table* table) {}
static const double* sd_prepared(sd_table* table, const double* constants, const double* length) { return 0; }
#endif

static int sd_run(sd_table* table, long long n, double* state, const double* constants, const double* samples,
                  double* outputs) {
  casadi_int iw[SD_IW + 1];
  double next[SD_STATE + 1];
  const double* arg[SD_ARG + 4];
  double* res[SD_RES + 2];
  long long k;
  for (k = 0; k < n; ++k) {
    const double* sample = samples + k * SD_SAMPLE;
    arg[0] = state; arg[1] = constants; arg[2] = sample;
    arg[3] = sd_prepared(table, constants, sample + SD_PACE);
    res[0] = next; res[1] = outputs + k * SD_OUTPUT;
    if (step(arg, res, iw, table->w, 0)) return 1;
    memcpy(state, next, sizeof(double) * SD_STATE);
  }
  return 0;
}

#ifdef SD_LANES
/* `SD_LANES` runs at once: the first of these, and the last ones again where there are fewer. */
static int sd_run_lanes(sd_table* tables, long long runs, long long n, double* states, const double* constants,
                        long long apart, const double* samples, double* outputs) {
  sd_v state[SD_STATE + 1], made[SD_STATE + 1], shared[SD_CONSTANTS + 1], sample[SD_SAMPLE], shown[SD_OUTPUT + 1];
  sd_v prepared[SD_PREPARED + 1], length = sd_all(0), memory[3 * SD_LANES_ONCES + 1];
  long long at[SD_LANES], k;
  int l, j;
  memset(memory, 0xff, sizeof memory);
  for (l = 0; l < SD_LANES; ++l) {
    at[l] = l < runs ? l : runs - 1;
    for (j = 0; j < SD_STATE; ++j) state[j][l] = states[at[l] * SD_STATE + j];
    for (j = 0; j < SD_CONSTANTS; ++j) shared[j][l] = constants[at[l] * apart + j];
  }
  for (k = 0; k < n; ++k) {
    for (l = 0; l < SD_LANES; ++l)
      for (j = 0; j < SD_SAMPLE; ++j) sample[j][l] = samples[(at[l] * n + k) * SD_SAMPLE + j];
    if (SD_PREPARED && (!k || sd_changed(length, sample[SD_PACE])))
      for (l = 0; l < SD_LANES; ++l) {
        const double pace = sample[SD_PACE][l];
        const double* found = sd_prepared(tables + (apart ? l : 0), constants + at[l] * apart, &pace);
        for (j = 0; j < SD_PREPARED; ++j) prepared[j][l] = found[j];
      }
    length = sample[SD_PACE];
    sd_step_lanes(state, shared, sample, prepared, made, shown, memory);
    memcpy(state, made, sizeof(sd_v) * SD_STATE);
    for (l = 0; l < SD_LANES; ++l)
      for (j = 0; j < SD_OUTPUT; ++j) outputs[(at[l] * n + k) * SD_OUTPUT + j] = shown[j][l];
  }
  for (l = 0; l < SD_LANES; ++l)
    for (j = 0; j < SD_STATE; ++j) states[at[l] * SD_STATE + j] = state[j][l];
  return 0;
}
#else
#define SD_LANES 1
static int sd_run_lanes(sd_table* tables, long long runs, long long n, double* states, const double* constants,
                        long long apart, const double* samples, double* outputs) {
  return sd_run(tables, n, states, constants, samples, outputs);
}
#endif

/* So many runs of n samples each, side by side in memory, each with constants `apart` from those before. */
int servo_daemon_loops(long long runs, long long n, double* states, const double* constants, long long apart,
                       const double* samples, double* outputs) {
  double w[SD_W + 1 + 3 * SD_ONCES];
  sd_table tables[SD_LANES];
  long long k, begun;
  int failed = 0, l;
  memset(w, 0xff, sizeof w); /* not a number, as is any function of it */
  for (begun = 0; begun < (apart ? SD_LANES : 1); ++begun) {
    if ((failed = sd_begin(tables + begun, apart ? n : runs * n))) break;
    tables[begun].w = w;
  }
  for (k = 0; k < runs && !failed; k += SD_LANES) {
    double* state = states + k * SD_STATE;
    const double *own = constants + k * apart, *sample = samples + k * n * SD_SAMPLE;
    double* output = outputs + k * n * SD_OUTPUT;
    for (l = 0; apart && k && l < SD_LANES; ++l) sd_forget(tables + l);
    if (runs - k > 1) failed = sd_run_lanes(tables, runs - k, n, state, own, apart, sample, output);
    else failed = sd_run(tables, n, state, own, sample, output);
  }
  while (begun) sd_end(tables + --begun);
  return failed;
}

int servo_daemon_loop(long long n, double* state, const double* constants, const double* samples, double* outputs) {
  return servo_daemon_loops(1, n, state, constants, 0, samples, outputs);
}
"""


#: Generated code asks of each argument and each result whether it is there. Of ours every one is, and each question
#: ends a stretch of code that a compiler can look at as a whole: without them it takes a fifth less.
_QUESTIONS = (
    (re.compile(r"\barg\[(\d)\]\? (arg\[\1\]\[\d+\]) : 0;"), r"\2;"),
    (re.compile(r"\bif \(res\[(\d)\]!=0\) (res\[\1\]\[)"), r"\2"),
)


def without_questions(source: str) -> str:
    """Generated code that takes every argument and result to be there."""
    for asked, taken in _QUESTIONS:
        source = asked.sub(taken, source)
    return source


def with_memory(source: str) -> str:
    """Generated code whose calls of the library are not made again for the same argument."""
    return _CALL.sub(_once, source)


def _once(call: re.Match[str]) -> str:
    name, arguments = call.groups()
    return f"=SD_ONCE{'_2' if ',' in arguments else ''}({name}, {arguments});"
