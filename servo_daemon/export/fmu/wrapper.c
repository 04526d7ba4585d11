/* FMI 2.0 for co-simulation around servo-daemon's compiled plant, which stands above. The types are those of
 * fmi2TypesPlatform.h and fmi2FunctionTypes.h (Modelica Association, FMI 2.0.4).
 * SPDX-License-Identifier: Apache-2.0
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef void *fmi2Component, *fmi2ComponentEnvironment, *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer, fmi2Boolean;
typedef char fmi2Char, fmi2Byte;
typedef const fmi2Char *fmi2String;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef struct {
    void (*logger)(fmi2ComponentEnvironment, fmi2String, fmi2Status, fmi2String, fmi2String, ...);
    void *(*allocateMemory)(size_t, size_t);
    void (*freeMemory)(void *);
    void (*stepFinished)(fmi2ComponentEnvironment, fmi2Status);
    fmi2ComponentEnvironment componentEnvironment;
} fmi2CallbackFunctions;

#if defined _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

#define GUID "@GUID@"
#define LONGEST_STEP @LONGEST@ /* s: the plant's step is exact for the linear motor, second order for its effects */
enum { NX = @NX@, NP = @NP@, VR_INPUT = 0, VR_OUTPUTS = 1, VR_STATES = 4, VR_PARAMETERS = 4 + NX, VR_END = 4 + NX + NP };

static const double INITIAL[NX + 1] = {@INITIAL@};
static const double PARAMETERS[NP + 1] = {@PARAMETERS@};
/* The motor's input from the drive's own; the drive's own outputs from the motor's. */
static const double INPUT_FACTOR = @INPUT_FACTOR@;
static const double OUTPUT_FACTORS[3] = {@OUTPUT_FACTORS@};

typedef struct {
    double x[NX], p[NP], u, t;
} Unit;

static void reset(Unit *unit) {
    memcpy(unit->x, INITIAL, sizeof unit->x);
    memcpy(unit->p, PARAMETERS, sizeof unit->p);
    unit->u = unit->t = 0.0;
}

static int sensed(const Unit *unit, double *shown) {
    long long iw[SZ_IW_SENSED + 1];
    double w[SZ_W_SENSED + 1];
    const double *arg[SZ_ARG_SENSED + 1] = {unit->x, unit->p, &unit->t};
    double *res[SZ_RES_SENSED + 1] = {shown};
    return servo_plant_sensed(arg, res, iw, w, 0);
}

static int advance(Unit *unit, double h) {
    long long iw[SZ_IW_STEP + 1];
    double w[SZ_W_STEP + 1], next[NX], u = INPUT_FACTOR * unit->u;
    const double *arg[SZ_ARG_STEP + 1] = {unit->x, &u, unit->p, &unit->t, &h};
    double *res[SZ_RES_STEP + 1] = {next};
    if (servo_plant_step(arg, res, iw, w, 0)) return 1;
    for (int k = 0; k < NX; k++)
        if (!isfinite(next[k])) return 1;
    memcpy(unit->x, next, sizeof next);
    return 0;
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                                     const fmi2CallbackFunctions *functions, fmi2Boolean visible, fmi2Boolean logging) {
    (void)name; (void)resources; (void)functions; (void)visible; (void)logging;
    if (type != fmi2CoSimulation || guid == NULL || strcmp(guid, GUID) != 0) return NULL;
    Unit *unit = malloc(sizeof *unit);
    if (unit != NULL) reset(unit);
    return unit;
}
EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }
EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String categories[]) {
    (void)c; (void)on; (void)n; (void)categories;
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean defined, fmi2Real tolerance, fmi2Real start,
                                      fmi2Boolean stops, fmi2Real stop) {
    (void)defined; (void)tolerance; (void)stops; (void)stop;
    ((Unit *)c)->t = start;
    return fmi2OK;
}
EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) { (void)c; return fmi2OK; }
EXPORT fmi2Status fmi2Terminate(fmi2Component c) { (void)c; return fmi2OK; }
EXPORT fmi2Status fmi2Reset(fmi2Component c) { reset(c); return fmi2OK; }

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[]) {
    Unit *unit = c;
    double shown[3];
    if (sensed(unit, shown)) return fmi2Error;
    for (size_t k = 0; k < n; k++) {
        const fmi2ValueReference r = vr[k];
        if (r >= VR_END) return fmi2Error;
        value[k] = r == VR_INPUT ? unit->u : r < VR_STATES ? OUTPUT_FACTORS[r - VR_OUTPUTS] * shown[r - VR_OUTPUTS]
                 : r < VR_PARAMETERS ? unit->x[r - VR_STATES] : unit->p[r - VR_PARAMETERS];
    }
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, const fmi2Real value[]) {
    Unit *unit = c;
    for (size_t k = 0; k < n; k++) {
        const fmi2ValueReference r = vr[k];
        if (r >= VR_END || (r >= VR_OUTPUTS && r < VR_STATES) || !isfinite(value[k])) return fmi2Error;
        if (r == VR_INPUT) unit->u = value[k];
        else if (r < VR_PARAMETERS) unit->x[r - VR_STATES] = value[k];
        else unit->p[r - VR_PARAMETERS] = value[k];
    }
    return fmi2OK;
}
/* There are none of these. */
#define NONE(name, type)                                                                                       \
    EXPORT fmi2Status name(fmi2Component c, const fmi2ValueReference vr[], size_t n, type value[]) {            \
        (void)c; (void)vr; (void)value;                                                                        \
        return n == 0 ? fmi2OK : fmi2Error;                                                                    \
    }
NONE(fmi2GetInteger, fmi2Integer)
NONE(fmi2GetBoolean, fmi2Boolean)
NONE(fmi2GetString, fmi2String)
NONE(fmi2SetInteger, const fmi2Integer)
NONE(fmi2SetBoolean, const fmi2Boolean)
NONE(fmi2SetString, const fmi2String)

EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state) {
    if (*state == NULL) *state = malloc(sizeof(Unit));
    if (*state == NULL) return fmi2Error;
    memcpy(*state, c, sizeof(Unit));
    return fmi2OK;
}
EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state) {
    memcpy(c, state, sizeof(Unit));
    return fmi2OK;
}
EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state) {
    (void)c;
    free(*state);
    *state = NULL;
    return fmi2OK;
}
EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size) {
    (void)c; (void)state;
    *size = sizeof(Unit);
    return fmi2OK;
}
EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[], size_t size) {
    (void)c;
    if (size < sizeof(Unit)) return fmi2Error;
    memcpy(bytes, state, sizeof(Unit));
    return fmi2OK;
}
EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state) {
    if (size < sizeof(Unit) || fmi2GetFMUstate(c, state) != fmi2OK) return fmi2Error;
    memcpy(*state, bytes, sizeof(Unit));
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference unknown[], size_t nu,
                                               const fmi2ValueReference known[], size_t nk, const fmi2Real dk[],
                                               fmi2Real du[]) {
    (void)c; (void)unknown; (void)nu; (void)known; (void)nk; (void)dk; (void)du;
    return fmi2Error; /* modelDescription.xml does not offer them */
}
EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                              const fmi2Integer order[], const fmi2Real value[]) {
    (void)c; (void)vr; (void)n; (void)order; (void)value;
    return fmi2Error;
}
EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                                               const fmi2Integer order[], fmi2Real value[]) {
    (void)c; (void)vr; (void)n; (void)order; (void)value;
    return fmi2Error;
}
EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real size, fmi2Boolean keep) {
    Unit *unit = c;
    (void)keep;
    if (!(size > 0.0)) return fmi2Error;
    const double steps = ceil(size / LONGEST_STEP * (1.0 - 1e-9));
    const double h = size / (steps < 1.0 ? 1.0 : steps);
    for (double k = 0; k < steps || k == 0; k++) {
        unit->t = time + k * h;
        if (advance(unit, h)) return fmi2Error;
    }
    unit->t = time + size;
    return fmi2OK;
}
EXPORT fmi2Status fmi2CancelStep(fmi2Component c) { (void)c; return fmi2Error; }
EXPORT fmi2Status fmi2GetStatus(fmi2Component c, int kind, fmi2Status *value) {
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}
EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, int kind, fmi2Real *value) {
    (void)kind;
    *value = ((Unit *)c)->t;
    return fmi2OK;
}
EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, int kind, fmi2Integer *value) {
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}
EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, int kind, fmi2Boolean *value) {
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}
EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, int kind, fmi2String *value) {
    (void)c; (void)kind; (void)value;
    return fmi2Discard;
}
