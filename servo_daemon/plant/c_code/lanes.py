"""A step for four runs at once: the generated code of one rewritten with vectors in the place of numbers.

Vector units add, multiply, divide and take roots of several numbers in the time of one, each rounded as it is alone;
what has no vector form (an exponential) is called for each. So every run gets the numbers that it gets by itself.
"""

from __future__ import annotations

import re

#: Runs side by side: what a register of AVX holds. Elsewhere compilers make two operations of one.
LANES = 4

_NAME, _NUMBER = r"a\d+", r"-?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
#: Statements of generated code and what becomes of them.
_RULES = tuple(
    (re.compile(f"^{pattern}$"), replacement)
    for pattern, replacement in (
        (rf"casadi_real ({_NAME}(?:, {_NAME})*);", r"sd_v \1;"),
        (rf"({_NAME})=arg\[([0-3])\]\[(\d+)\];", r"\1=sd_given\2[\3];"),
        (rf"res\[([01])\]\[(\d+)\]=({_NAME});", r"sd_made\1[\2]=\3;"),
        (rf"({_NAME})=({_NUMBER});", r"\1=sd_all(\2);"),
        (rf"({_NAME})=({_NAME});", r"\1=\2;"),
        (rf"({_NAME})=\(-({_NAME})\);", r"\1=-\2;"),
        (rf"({_NAME})=\(({_NAME})([-+*/])({_NAME})\);", r"\1=\2\3\4;"),
        (rf"({_NAME})=\(({_NUMBER})([-+*/])({_NAME})\);", r"\1=sd_all(\2)\3\4;"),
        (rf"({_NAME})=\(({_NAME})([-+*/])({_NUMBER})\);", r"\1=\2\3sd_all(\4);"),
        (rf"({_NAME})=\(({_NAME})(<|<=|==|!=)({_NAME})\);", r"\1=sd_truth(\2\3\4);"),
        (rf"({_NAME})=\(!({_NAME})\);", r"\1=sd_truth(\2==sd_all(0));"),
        (rf"({_NAME})=\(({_NAME})&&({_NAME})\);", r"\1=sd_truth((\2!=sd_all(0))&(\3!=sd_all(0)));"),
        (rf"({_NAME})=\(({_NAME})\|\|({_NAME})\);", r"\1=sd_truth((\2!=sd_all(0))|(\3!=sd_all(0)));"),
        (rf"({_NAME})=\(({_NAME})\?({_NAME}):0\);", r"\1=sd_where(\2!=sd_all(0), \3);"),
        (rf"({_NAME})=casadi_fabs\(\s*({_NAME})\);", r"\1=sd_fabs(\2);"),
        (rf"({_NAME})=casadi_sign\(\s*({_NAME})\);", r"\1=sd_sign(\2);"),
        (rf"({_NAME})=casadi_sq\(\s*({_NAME})\);", r"\1=\2*\2;"),
        (rf"({_NAME})=sqrt\(\s*({_NAME})\);", r"\1=sd_sqrt(\2);"),
        (rf"({_NAME})=casadi_(fmin|fmax)\(({_NAME}),({_NAME})\);", r"\1=sd_\2(\3, \4);"),
        (rf"({_NAME})=SD_ONCE\((\w+), ({_NAME})\);", r"\1=SD_LANES_ONCE(\2, \3);"),
        (rf"({_NAME})=SD_ONCE_2\((\w+), ({_NAME}),({_NAME})\);", r"\1=SD_LANES_ONCE_2(\2, \3, \4);"),
        (rf"({_NAME})=(exp|log|sin|cos|tanh|atanh|casadi_expm1)\(\s*({_NAME})\s*\);", r"\1=sd_each(\2, \3);"),
        (rf"({_NAME})=atan2\(({_NAME}),({_NAME})\);", r"\1=sd_atan2(\2, \3);"),
        (r"return 0;", r"return;"),
        (r"}", r"}"),
    )
)
#: Calls `step` by its own name; the function that it passes its arguments on to has the code.
_ENTRY = re.compile(r"int step\(const casadi_real\*\* arg.*?\{\s*return (casadi_f\d+)\(", re.DOTALL)

_VECTORS = f"""
#if defined(__GNUC__) && !defined(__TINYC__)
#define SD_LANES {LANES}
typedef double sd_v __attribute__((vector_size(8 * SD_LANES), may_alias));
typedef long long sd_m __attribute__((vector_size(8 * SD_LANES), may_alias));
#define sd_all(x) ((sd_v){{(x), (x), (x), (x)}})
#define sd_where(mask, x) ((sd_v)((sd_m)(mask) & (sd_m)(x)))
#define sd_truth(mask) sd_where(mask, sd_all(1))
#define sd_fabs(x) ((sd_v)((sd_m)(x) & 0x7fffffffffffffffLL))
#define sd_choice(mask, x, y) ((sd_v)(((sd_m)(mask) & (sd_m)(x)) | (~(sd_m)(mask) & (sd_m)(y))))
static inline sd_v sd_sign(sd_v x) {{
  return sd_choice(x < sd_all(0), sd_all(-1), sd_choice(x > sd_all(0), sd_all(1), x));
}}
#ifdef __AVX__
#define sd_sqrt(x) ((sd_v)__builtin_ia32_sqrtpd256(x))
#define sd_none(mask) (!__builtin_ia32_movmskpd256((sd_v)(mask)))
#else
static inline sd_v sd_sqrt(sd_v x) {{ return (sd_v){{sqrt(x[0]), sqrt(x[1]), sqrt(x[2]), sqrt(x[3])}}; }}
static inline int sd_none(sd_m mask) {{ return !(mask[0] | mask[1] | mask[2] | mask[3]); }}
#endif
/* Of a number and what is none the number. Of two zeros the compiler chooses one for the library's functions, too. */
static inline sd_v sd_fmax(sd_v x, sd_v y) {{ return sd_choice((x > y) | (y != y), x, y); }}
static inline sd_v sd_fmin(sd_v x, sd_v y) {{ return sd_choice((x < y) | (y != y), x, y); }}
/* As SD_ONCE: what stays the same is not computed again, run by run. */
static __attribute__((noinline)) void sd_once(double (*f)(double), sd_v* m, sd_v x) {{
  int k;
  for (k = 0; k < SD_LANES; ++k)
    if (!sd_same((double*)m + k, (double*)&x + k)) m[2][k] = f(x[k]);
  m[0] = x;
}}
static __attribute__((noinline)) void sd_once_2(double (*f)(double, double), sd_v* m, sd_v x, sd_v y) {{
  int k;
  for (k = 0; k < SD_LANES; ++k)
    if (!sd_same((double*)m + k, (double*)&x + k) || !sd_same((double*)(m + 1) + k, (double*)&y + k))
      m[2][k] = f(x[k], y[k]);
  m[0] = x; m[1] = y;
}}
static __attribute__((noinline)) sd_v sd_each(double (*f)(double), sd_v x) {{
  sd_v out;
  int k;
  for (k = 0; k < SD_LANES; ++k) out[k] = f(x[k]);
  return out;
}}
static __attribute__((noinline)) sd_v sd_atan2(sd_v y, sd_v x) {{
  sd_v out;
  int k;
  for (k = 0; k < SD_LANES; ++k) out[k] = atan2(y[k], x[k]);
  return out;
}}
static inline int sd_changed(sd_v one, sd_v other) {{ return !sd_none((sd_m)one != (sd_m)other); }}
enum {{ SD_LANES_FIRST = __COUNTER__ }};
#define SD_LANES_ONCE(f, x) ({{ \\
  sd_v* m_ = sd_memory + 3 * (__COUNTER__ - SD_LANES_FIRST - 1); const sd_v x_ = (x); \\
  if (sd_changed(m_[0], x_)) sd_once(f, m_, x_); \\
  m_[2]; }})
#define SD_LANES_ONCE_2(f, x, y) ({{ \\
  sd_v* m_ = sd_memory + 3 * (__COUNTER__ - SD_LANES_FIRST - 1); const sd_v x_ = (x), y_ = (y); \\
  if (sd_changed(m_[0], x_) || sd_changed(m_[1], y_)) sd_once_2(f, m_, x_, y_); \\
  m_[2]; }})
static void sd_step_lanes(const sd_v* sd_given0, const sd_v* sd_given1, const sd_v* sd_given2, const sd_v* sd_given3,
                          sd_v* sd_made0, sd_v* sd_made1, sd_v* sd_memory) {{
"""
_AFTER = """
enum { SD_LANES_ONCES = __COUNTER__ - SD_LANES_FIRST };
#endif
"""


def body_of(source: str) -> list[str] | None:
    """The lines of a step's body, from its declarations to its last brace; None: there is none that is known here."""
    entry = _ENTRY.search(source)
    if entry is None:
        return None
    body = source[source.index(f"static int {entry[1]}(") :]
    return body[body.index("{\n") + 2 : body.index("\n}\n") + 2].splitlines()


def in_lanes(source: str) -> str:
    """C code of the step for `LANES` runs at once (`sd_step_lanes`); empty: it has a statement that is not known here.

    Args:
        source: generated code `without_questions`, with a function `step`, its calls written as `SD_ONCE`.
    """
    lines = body_of(source)
    if lines is None:
        return ""
    made = [_rewritten(line.strip()) for line in lines]
    return "" if None in made else _VECTORS + "\n".join(m for m in made if m is not None) + _AFTER


def _rewritten(statement: str) -> str | None:
    for pattern, replacement in _RULES:
        if pattern.match(statement):
            return pattern.sub(replacement, statement)
    return None
