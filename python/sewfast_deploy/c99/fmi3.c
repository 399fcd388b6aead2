@OPENING
/* The functions of FMI 3.0 for co-simulation (https://fmi-standard.org/docs/3.0.1/), their types written out. */
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "@NAME.h"

#if defined _WIN32
#define PUBLIC __declspec(dllexport)
#else
#define PUBLIC __attribute__((visibility("default")))
#endif

typedef void *Instance;
typedef void *Environment;
typedef uint32_t Reference;
typedef const char *String;
typedef enum { OK, WARNING, DISCARD, ERROR, FATAL } Status;
typedef void (*Log)(Environment environment, Status status, String category, String message);

#define TOKEN "@TOKEN"
#define INPUTS @INPUTS
#define OUTPUT (INPUTS + 1) /* value references: 0 time, then inputs, then the output */
#define TS @TS
#define TOO_LONG 1e9 /* samples of one step */

/* All that a run consists of: copied as a whole where the state is asked for. */
typedef struct {
    @KIND system;
    double u[INPUTS], y, time;
} State;

typedef struct {
    State now;
    Log log;
    Environment environment;
} Component;

static Status say(const Component *c, Status status, const char *message)
{
    if (c != NULL && c->log != NULL) {
        c->log(c->environment, status, status == ERROR ? "logStatusError" : "logStatusWarning", message);
    }
    return status;
}

static void begin(State *now)
{
    static const double starts[] = {@STARTS};
    memset(now, 0, sizeof *now);
    memcpy(now->u, starts, sizeof starts);
    @NAME_init(&now->system);
}

/* One sample with the inputs as they are. */
static double advance(@KIND *system, const double *u)
{
@ADVANCE}

/* The output now, of which the inputs may be part. */
static double output(const State *now)
{
@OUTPUT_NOW}

PUBLIC const char *fmi3GetVersion(void)
{
    return "3.0";
}

PUBLIC Status fmi3SetDebugLogging(Instance instance, bool on, size_t count, const String *categories)
{
    (void)instance, (void)on, (void)count, (void)categories;
    return OK;
}

PUBLIC Instance fmi3InstantiateCoSimulation(
    String name, String token, String resources, bool visible, bool logging, bool events, bool early,
    const Reference *intermediate, size_t count, Environment environment, Log log, void *update)
{
    Component *c;
    (void)name, (void)resources, (void)visible, (void)logging, (void)events, (void)early;
    (void)intermediate, (void)count, (void)update;
    if (token == NULL || strcmp(token, TOKEN) != 0) {
        if (log != NULL) {
            log(environment, ERROR, "logStatusError", "the instantiation token is not that of this FMU");
        }
        return NULL;
    }
    c = (Component *)malloc(sizeof *c);
    if (c != NULL) {
        c->log = log;
        c->environment = environment;
        begin(&c->now);
    }
    return c;
}

PUBLIC Instance fmi3InstantiateModelExchange(
    String name, String token, String resources, bool visible, bool logging, Environment environment, Log log)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    return NULL;
}

PUBLIC Instance fmi3InstantiateScheduledExecution(
    String name, String token, String resources, bool visible, bool logging, Environment environment, Log log,
    void *clock, void *lock, void *unlock)
{
    (void)name, (void)token, (void)resources, (void)visible, (void)logging, (void)environment, (void)log;
    (void)clock, (void)lock, (void)unlock;
    return NULL;
}

PUBLIC void fmi3FreeInstance(Instance instance)
{
    free(instance);
}

PUBLIC Status fmi3EnterInitializationMode(
    Instance instance, bool has_tolerance, double tolerance, double start, bool has_stop, double stop)
{
    Component *c = (Component *)instance;
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    c->now.time = start;
    return OK;
}

PUBLIC Status fmi3ExitInitializationMode(Instance instance)
{
    (void)instance;
    return OK;
}

PUBLIC Status fmi3EnterEventMode(Instance instance)
{
    (void)instance;
    return OK;
}

PUBLIC Status fmi3EnterStepMode(Instance instance)
{
    (void)instance;
    return OK;
}

PUBLIC Status fmi3EnterConfigurationMode(Instance instance)
{
    return say((Component *)instance, ERROR, "there is nothing to configure");
}

PUBLIC Status fmi3ExitConfigurationMode(Instance instance)
{
    return say((Component *)instance, ERROR, "there is nothing to configure");
}

PUBLIC Status fmi3Terminate(Instance instance)
{
    (void)instance;
    return OK;
}

PUBLIC Status fmi3Reset(Instance instance)
{
    begin(&((Component *)instance)->now);
    return OK;
}

PUBLIC Status fmi3DoStep(
    Instance instance, double time, double size, bool no_set_before, bool *event, bool *terminate, bool *early,
    double *reached)
{
    Component *c = (Component *)instance;
    const double samples = size / TS, whole = (double)(int64_t)(samples < TOO_LONG ? samples + 0.5 : 0.0);
    int64_t k;
    (void)no_set_before;
    *event = *terminate = *early = false;
    *reached = time;
    if (!(whole >= 1.0 && samples - whole < 1e-6 && whole - samples < 1e-6)) {
        return say(c, ERROR, "expected a step of a whole number of sample times of @TS s");
    }
    for (k = 0; k < (int64_t)whole; k++) {
        c->now.y = advance(&c->now.system, c->now.u);
    }
    c->now.time = time + size;
    *reached = c->now.time;
    return OK;
}

PUBLIC Status fmi3GetFloat64(
    Instance instance, const Reference *references, size_t count, double *values, size_t length)
{
    const Component *c = (const Component *)instance;
    size_t i;
    if (length < count) {
        return say(c, ERROR, "expected room for a value each");
    }
    for (i = 0; i < count; i++) {
        const Reference r = references[i];
        if (r > OUTPUT) {
            return say(c, ERROR, "there is no variable of this value reference");
        }
        values[i] = r == 0 ? c->now.time : r == OUTPUT ? output(&c->now) : c->now.u[r - 1];
    }
    return OK;
}

PUBLIC Status fmi3SetFloat64(
    Instance instance, const Reference *references, size_t count, const double *values, size_t length)
{
    Component *c = (Component *)instance;
    size_t i;
    if (length < count) {
        return say(c, ERROR, "expected a value each");
    }
    for (i = 0; i < count; i++) {
        if (references[i] == 0 || references[i] >= OUTPUT) {
            return say(c, ERROR, "only inputs can be set");
        }
        c->now.u[references[i] - 1] = values[i];
    }
    return OK;
}

/* Variables of other types, derivatives and clocks: there are none. */
#define NONE(name, type) \
    PUBLIC Status fmi3Get##name( \
        Instance instance, const Reference *references, size_t count, type *values, size_t length) \
    { \
        (void)references, (void)values, (void)length; \
        return count == 0 ? OK : say((Component *)instance, ERROR, "there is no variable of this type"); \
    } \
    PUBLIC Status fmi3Set##name( \
        Instance instance, const Reference *references, size_t count, const type *values, size_t length) \
    { \
        (void)references, (void)values, (void)length; \
        return count == 0 ? OK : say((Component *)instance, ERROR, "there is no variable of this type"); \
    }

NONE(Float32, float)
NONE(Int8, int8_t)
NONE(UInt8, uint8_t)
NONE(Int16, int16_t)
NONE(UInt16, uint16_t)
NONE(Int32, int32_t)
NONE(UInt32, uint32_t)
NONE(Int64, int64_t)
NONE(UInt64, uint64_t)
NONE(Boolean, bool)
NONE(String, String)

PUBLIC Status fmi3GetBinary(
    Instance instance, const Reference *references, size_t count, size_t *sizes, const uint8_t **values,
    size_t length)
{
    (void)references, (void)sizes, (void)values, (void)length;
    return count == 0 ? OK : say((Component *)instance, ERROR, "there is no variable of this type");
}

PUBLIC Status fmi3SetBinary(
    Instance instance, const Reference *references, size_t count, const size_t *sizes,
    const uint8_t *const *values, size_t length)
{
    (void)references, (void)sizes, (void)values, (void)length;
    return count == 0 ? OK : say((Component *)instance, ERROR, "there is no variable of this type");
}

PUBLIC Status fmi3GetClock(Instance instance, const Reference *references, size_t count, bool *values)
{
    (void)references, (void)values;
    return count == 0 ? OK : say((Component *)instance, ERROR, "there are no clocks");
}

PUBLIC Status fmi3SetClock(Instance instance, const Reference *references, size_t count, const bool *values)
{
    (void)references, (void)values;
    return count == 0 ? OK : say((Component *)instance, ERROR, "there are no clocks");
}

PUBLIC Status fmi3GetFMUState(Instance instance, void **state)
{
    Component *c = (Component *)instance;
    if (*state == NULL) {
        *state = malloc(sizeof(State));
    }
    if (*state == NULL) {
        return say(c, ERROR, "no memory for the state");
    }
    memcpy(*state, &c->now, sizeof(State));
    return OK;
}

PUBLIC Status fmi3SetFMUState(Instance instance, void *state)
{
    Component *c = (Component *)instance;
    if (state == NULL) {
        return say(c, ERROR, "expected a state");
    }
    memcpy(&c->now, state, sizeof(State));
    return OK;
}

PUBLIC Status fmi3FreeFMUState(Instance instance, void **state)
{
    (void)instance;
    free(*state);
    *state = NULL;
    return OK;
}

PUBLIC Status fmi3SerializedFMUStateSize(Instance instance, void *state, size_t *size)
{
    (void)instance, (void)state;
    *size = sizeof(State);
    return OK;
}

PUBLIC Status fmi3SerializeFMUState(Instance instance, void *state, uint8_t *bytes, size_t size)
{
    if (state == NULL || size < sizeof(State)) {
        return say((Component *)instance, ERROR, "expected room for the state");
    }
    memcpy(bytes, state, sizeof(State));
    return OK;
}

PUBLIC Status fmi3DeserializeFMUState(Instance instance, const uint8_t *bytes, size_t size, void **state)
{
    if (size != sizeof(State)) {
        return say((Component *)instance, ERROR, "these bytes are no state of this FMU");
    }
    if (*state == NULL) {
        *state = malloc(sizeof(State));
    }
    if (*state == NULL) {
        return say((Component *)instance, ERROR, "no memory for the state");
    }
    memcpy(*state, bytes, sizeof(State));
    return OK;
}

/* The rest of the standard's list, of which a discrete system without clocks has nothing. */
#define ABSENT \
    { \
        return say((Component *)instance, ERROR, "this function is not part of this FMU"); \
    }

PUBLIC Status fmi3GetNumberOfVariableDependencies(Instance instance, Reference a, size_t *b) ABSENT
PUBLIC Status fmi3GetVariableDependencies(
    Instance instance, Reference a, size_t *b, Reference *c, size_t *d, int *e, size_t f) ABSENT
PUBLIC Status fmi3GetDirectionalDerivative(
    Instance instance, const Reference *a, size_t b, const Reference *c, size_t d, const double *e, size_t f, double *g, size_t h) ABSENT
PUBLIC Status fmi3GetAdjointDerivative(
    Instance instance, const Reference *a, size_t b, const Reference *c, size_t d, const double *e, size_t f, double *g, size_t h) ABSENT
PUBLIC Status fmi3EvaluateDiscreteStates(Instance instance) ABSENT
PUBLIC Status fmi3UpdateDiscreteStates(
    Instance instance, bool *a, bool *b, bool *c, bool *d, bool *e, double *f) ABSENT
PUBLIC Status fmi3EnterContinuousTimeMode(Instance instance) ABSENT
PUBLIC Status fmi3CompletedIntegratorStep(Instance instance, bool a, bool *b, bool *c) ABSENT
PUBLIC Status fmi3SetTime(Instance instance, double a) ABSENT
PUBLIC Status fmi3SetContinuousStates(Instance instance, const double *a, size_t b) ABSENT
PUBLIC Status fmi3GetContinuousStateDerivatives(Instance instance, double *a, size_t b) ABSENT
PUBLIC Status fmi3GetEventIndicators(Instance instance, double *a, size_t b) ABSENT
PUBLIC Status fmi3GetContinuousStates(Instance instance, double *a, size_t b) ABSENT
PUBLIC Status fmi3GetNominalsOfContinuousStates(Instance instance, double *a, size_t b) ABSENT
PUBLIC Status fmi3GetNumberOfEventIndicators(Instance instance, size_t *a) ABSENT
PUBLIC Status fmi3GetNumberOfContinuousStates(Instance instance, size_t *a) ABSENT
PUBLIC Status fmi3GetOutputDerivatives(
    Instance instance, const Reference *a, size_t b, const int32_t *c, double *d, size_t e) ABSENT
PUBLIC Status fmi3ActivateModelPartition(Instance instance, Reference a, double b) ABSENT
PUBLIC Status fmi3GetIntervalDecimal(Instance instance, const Reference *a, size_t b, double *c, int *d) ABSENT
PUBLIC Status fmi3GetIntervalFraction(
    Instance instance, const Reference *a, size_t b, uint64_t *c, uint64_t *d, int *e) ABSENT
PUBLIC Status fmi3GetShiftDecimal(Instance instance, const Reference *a, size_t b, double *c) ABSENT
PUBLIC Status fmi3GetShiftFraction(
    Instance instance, const Reference *a, size_t b, uint64_t *c, uint64_t *d) ABSENT
PUBLIC Status fmi3SetIntervalDecimal(Instance instance, const Reference *a, size_t b, const double *c) ABSENT
PUBLIC Status fmi3SetIntervalFraction(
    Instance instance, const Reference *a, size_t b, const uint64_t *c, const uint64_t *d) ABSENT
PUBLIC Status fmi3SetShiftDecimal(Instance instance, const Reference *a, size_t b, const double *c) ABSENT
PUBLIC Status fmi3SetShiftFraction(
    Instance instance, const Reference *a, size_t b, const uint64_t *c, const uint64_t *d) ABSENT
