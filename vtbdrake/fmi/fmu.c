/* The functions of FMI 3.0 (co-simulation) of an exported testbed.

What stands before this text: the header fmi3FunctionTypes.h, TOKEN, N_VARIABLES, N_VALUES, N_OUTPUTS, and the tables
`variables`, `start_values`, `lower_values`, `upper_values`. What stands behind it computes, and defines the functions
model_... below. Each returns 0, or writes a sentence to `message`. */

#include <math.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MESSAGE_SIZE 2048

typedef struct Model Model;

static Model *model_new(const char *resources, char *message);
/* Begin at a time, with the values of the start. */
static int model_begin(Model *model, double time, char *message);
/* End the initialization: what happens at the first instant happens. */
static int model_start(Model *model, char *message);
/* Write the values of a variable, which begin at `first` among all values that can be set. */
static int model_write(Model *model, int first, int size, const double *values, char *message);
static int model_outputs(Model *model, double *outputs, char *message);
static int model_advance(Model *model, double end, char *message);
/* Return the whole state in memory of its own, or NULL. */
static void *model_save(Model *model, size_t *size, char *message);
static int model_load(Model *model, const void *state, size_t size, char *message);
static void model_free(Model *model);

typedef enum { INSTANTIATED, INITIALIZATION, STEP, TERMINATED } Mode;

/* All of an instance that is no part of the model, and can be copied byte by byte. */
typedef struct {
    char token[sizeof(TOKEN)];
    uint64_t size; /* of the model's state behind it, in bytes */
    int32_t mode;
    int32_t pad;
    double time;
    double values[N_VALUES + 1];
    uint8_t written[N_VARIABLES]; /* whether the model lacks the values of a variable */
} Front;

typedef struct {
    Front front;
    Model *model;
    double outputs[N_OUTPUTS + 1];
    int outputs_are_known;
    fmi3InstanceEnvironment environment;
    fmi3LogMessageCallback log;
} Instance;

static fmi3Status failed(Instance *instance, const char *format, ...) {
    char text[MESSAGE_SIZE + 256];
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(text, sizeof(text), format, arguments);
    va_end(arguments);
    if (instance->log) instance->log(instance->environment, fmi3Error, "logStatusError", text);
    return fmi3Error;
}

#define TRY(call)                                                                        \
    do {                                                                                 \
        char message[MESSAGE_SIZE] = "";                                                 \
        if (call) return failed(instance, "t = %.9g s: %s", instance->front.time, message); \
    } while (0)

#define MODE_IS(expected, function)                                                        \
    do {                                                                                   \
        if (!(expected)) return failed(instance, "%s is not allowed in this mode", function); \
    } while (0)

static void reset(Instance *instance) {
    Front *front = &instance->front;
    memset(front, 0, sizeof(*front));
    memcpy(front->token, TOKEN, sizeof(TOKEN));
    memcpy(front->values, start_values, N_VALUES * sizeof(double));
    front->mode = INSTANTIATED;
    instance->outputs_are_known = 0;
}

/* -- the life of an instance */

const char *fmi3GetVersion(void) { return "3.0"; }

fmi3SetDebugLoggingTYPE fmi3SetDebugLogging;
fmi3Status fmi3SetDebugLogging(fmi3Instance i, fmi3Boolean on, size_t n, const fmi3String categories[]) {
    (void)i, (void)on, (void)n, (void)categories; /* Errors are always told, and nothing else. */
    return fmi3OK;
}

fmi3InstantiateCoSimulationTYPE fmi3InstantiateCoSimulation;
fmi3Instance fmi3InstantiateCoSimulation(fmi3String name, fmi3String token, fmi3String resources, fmi3Boolean visible,
                                         fmi3Boolean logging, fmi3Boolean events, fmi3Boolean early,
                                         const fmi3ValueReference intermediate[], size_t n_intermediate,
                                         fmi3InstanceEnvironment environment, fmi3LogMessageCallback log,
                                         fmi3IntermediateUpdateCallback update) {
    (void)name, (void)visible, (void)logging, (void)events, (void)early, (void)intermediate, (void)n_intermediate;
    (void)update;
    Instance *instance = calloc(1, sizeof(Instance));
    if (!instance) return NULL;
    instance->environment = environment;
    instance->log = log;
    char message[MESSAGE_SIZE] = "";
    if (!token || strcmp(token, TOKEN))
        failed(instance, "the instantiation token is %s, and that of this FMU %s", token ? token : "missing", TOKEN);
    else if (!(instance->model = model_new(resources ? resources : "", message)))
        failed(instance, "%s", message);
    if (!instance->model) {
        free(instance);
        return NULL;
    }
    reset(instance);
    return instance;
}

fmi3Instance fmi3InstantiateModelExchange(void) { return NULL; }
fmi3Instance fmi3InstantiateScheduledExecution(void) { return NULL; }

fmi3FreeInstanceTYPE fmi3FreeInstance;
void fmi3FreeInstance(fmi3Instance i) {
    Instance *instance = i;
    if (!instance) return;
    model_free(instance->model);
    free(instance);
}

fmi3EnterInitializationModeTYPE fmi3EnterInitializationMode;
fmi3Status fmi3EnterInitializationMode(fmi3Instance i, fmi3Boolean has_tolerance, fmi3Float64 tolerance,
                                       fmi3Float64 start, fmi3Boolean has_stop, fmi3Float64 stop) {
    (void)has_tolerance, (void)tolerance, (void)has_stop, (void)stop;
    Instance *instance = i;
    MODE_IS(instance->front.mode == INSTANTIATED, "fmi3EnterInitializationMode");
    instance->front.time = start;
    TRY(model_begin(instance->model, start, message));
    instance->front.mode = INITIALIZATION;
    return fmi3OK;
}

/* Give the model what has been set since the last time. */
static fmi3Status flush(Instance *instance) {
    Front *front = &instance->front;
    for (int k = 0; k < N_VARIABLES; k++) {
        const Variable *variable = &variables[k];
        if (!front->written[k]) continue;
        TRY(model_write(instance->model, variable->first, variable->size, front->values + variable->first, message));
        front->written[k] = 0;
    }
    return fmi3OK;
}

fmi3ExitInitializationModeTYPE fmi3ExitInitializationMode;
fmi3Status fmi3ExitInitializationMode(fmi3Instance i) {
    Instance *instance = i;
    MODE_IS(instance->front.mode == INITIALIZATION, "fmi3ExitInitializationMode");
    if (flush(instance) != fmi3OK) return fmi3Error;
    instance->outputs_are_known = 0;
    TRY(model_start(instance->model, message));
    instance->front.mode = STEP;
    return fmi3OK;
}

fmi3TerminateTYPE fmi3Terminate;
fmi3Status fmi3Terminate(fmi3Instance i) {
    Instance *instance = i;
    MODE_IS(instance->front.mode == STEP, "fmi3Terminate");
    instance->front.mode = TERMINATED;
    return fmi3OK;
}

fmi3ResetTYPE fmi3Reset;
fmi3Status fmi3Reset(fmi3Instance i) {
    reset(i);
    return fmi3OK;
}

/* -- values */

static int find(Instance *instance, fmi3ValueReference reference, size_t left, fmi3Status *status) {
    if (reference >= N_VARIABLES)
        *status = failed(instance, "there is no variable with the value reference %u", reference);
    else if (left < (size_t)variables[reference].size)
        *status = failed(instance, "%s has %d values, but there are %zu", variables[reference].name,
                         variables[reference].size, left);
    else
        return 1;
    return 0;
}

fmi3GetFloat64TYPE fmi3GetFloat64;
fmi3Status fmi3GetFloat64(fmi3Instance i, const fmi3ValueReference references[], size_t n, fmi3Float64 values[],
                          size_t n_values) {
    Instance *instance = i;
    Front *front = &instance->front;
    fmi3Status status = fmi3OK;
    size_t at = 0;
    for (size_t k = 0; k < n; k++) {
        if (!find(instance, references[k], n_values - at, &status)) return status;
        const Variable *variable = &variables[references[k]];
        const double *from = front->values + variable->first;
        if (variable->kind == TIME) from = &front->time;
        if (variable->kind == OUTPUT) {
            MODE_IS(front->mode != INSTANTIATED, "reading outputs");
            if (!instance->outputs_are_known) {
                if (flush(instance) != fmi3OK) return fmi3Error;
                TRY(model_outputs(instance->model, instance->outputs, message));
                instance->outputs_are_known = 1;
            }
            from = instance->outputs + variable->first;
        }
        memcpy(values + at, from, variable->size * sizeof(double));
        at += variable->size;
    }
    return fmi3OK;
}

static fmi3Status check_set(Instance *instance, const Variable *variable, const double *values) {
    const Front *front = &instance->front;
    if (variable->kind == TIME || variable->kind == OUTPUT)
        return failed(instance, "%s is no input and no parameter: it cannot be set", variable->name);
    if (front->mode == TERMINATED || (variable->kind == FIXED && front->mode == STEP))
        return failed(instance, "%s can be set until the end of the initialization only", variable->name);
    for (int k = 0; k < variable->size; k++) {
        double lower = lower_values[variable->first + k], upper = upper_values[variable->first + k];
        if (!isfinite(values[k]) || values[k] < lower || values[k] > upper)
            return failed(instance, "%s must be finite and lie in [%g, %g], not be %g", variable->name, lower, upper,
                          values[k]);
    }
    return fmi3OK;
}

fmi3SetFloat64TYPE fmi3SetFloat64;
fmi3Status fmi3SetFloat64(fmi3Instance i, const fmi3ValueReference references[], size_t n, const fmi3Float64 values[],
                          size_t n_values) {
    Instance *instance = i;
    Front *front = &instance->front;
    fmi3Status status = fmi3OK;
    size_t at = 0;
    for (size_t k = 0; k < n; k++) {
        if (!find(instance, references[k], n_values - at, &status)) return status;
        const Variable *variable = &variables[references[k]];
        if (check_set(instance, variable, values + at) != fmi3OK) return fmi3Error;
        memcpy(front->values + variable->first, values + at, variable->size * sizeof(double));
        front->written[references[k]] = 1;
        instance->outputs_are_known = 0;
        at += variable->size;
    }
    return fmi3OK;
}

/* -- steps */

fmi3DoStepTYPE fmi3DoStep;
fmi3Status fmi3DoStep(fmi3Instance i, fmi3Float64 point, fmi3Float64 step, fmi3Boolean no_set_before,
                      fmi3Boolean *event_needed, fmi3Boolean *terminate, fmi3Boolean *early, fmi3Float64 *last) {
    (void)no_set_before;
    Instance *instance = i;
    Front *front = &instance->front;
    *event_needed = *terminate = *early = fmi3False;
    *last = front->time;
    MODE_IS(front->mode == STEP, "fmi3DoStep");
    if (!(step > 0.0) || !isfinite(step)) return failed(instance, "a step lasts a positive time in s, not %g", step);
    if (fabs(point - front->time) > 1e-9 * fmax(1.0, fabs(front->time)))
        return failed(instance, "the step begins at t = %.12g s, but the FMU is at %.12g s", point, front->time);
    if (flush(instance) != fmi3OK) return fmi3Error;
    instance->outputs_are_known = 0;
    TRY(model_advance(instance->model, point + step, message));
    *last = front->time = point + step;
    return fmi3OK;
}

/* -- the state */

fmi3GetFMUStateTYPE fmi3GetFMUState;
fmi3Status fmi3GetFMUState(fmi3Instance i, fmi3FMUState *state) {
    Instance *instance = i;
    size_t size = 0;
    char message[MESSAGE_SIZE] = "";
    void *inner = instance->front.mode == INSTANTIATED ? calloc(1, 1) : model_save(instance->model, &size, message);
    char *whole = inner ? realloc(*state, sizeof(Front) + size) : NULL;
    if (!whole) {
        free(inner);
        return failed(instance, "t = %.9g s: %s", instance->front.time, *message ? message : "there is no memory left");
    }
    instance->front.size = size;
    memcpy(whole, &instance->front, sizeof(Front));
    memcpy(whole + sizeof(Front), inner, size);
    free(inner);
    *state = whole;
    return fmi3OK;
}

fmi3SetFMUStateTYPE fmi3SetFMUState;
fmi3Status fmi3SetFMUState(fmi3Instance i, fmi3FMUState state) {
    Instance *instance = i;
    const Front *front = state;
    if (!state) return failed(instance, "there is no state to set");
    if (front->mode != INSTANTIATED)
        TRY(model_load(instance->model, (const char *)state + sizeof(Front), front->size, message));
    memcpy(&instance->front, front, sizeof(Front));
    instance->outputs_are_known = 0;
    return fmi3OK;
}

fmi3FreeFMUStateTYPE fmi3FreeFMUState;
fmi3Status fmi3FreeFMUState(fmi3Instance i, fmi3FMUState *state) {
    (void)i;
    free(*state);
    *state = NULL;
    return fmi3OK;
}

fmi3SerializedFMUStateSizeTYPE fmi3SerializedFMUStateSize;
fmi3Status fmi3SerializedFMUStateSize(fmi3Instance i, fmi3FMUState state, size_t *size) {
    if (!state) return failed(i, "there is no state to serialize");
    *size = sizeof(Front) + ((const Front *)state)->size;
    return fmi3OK;
}

fmi3SerializeFMUStateTYPE fmi3SerializeFMUState;
fmi3Status fmi3SerializeFMUState(fmi3Instance i, fmi3FMUState state, fmi3Byte bytes[], size_t size) {
    if (!state || size < sizeof(Front) + ((const Front *)state)->size)
        return failed(i, "the state needs more than %zu bytes", size);
    memcpy(bytes, state, sizeof(Front) + ((const Front *)state)->size);
    return fmi3OK;
}

fmi3DeserializeFMUStateTYPE fmi3DeserializeFMUState;
fmi3Status fmi3DeserializeFMUState(fmi3Instance i, const fmi3Byte bytes[], size_t size, fmi3FMUState *state) {
    Front front;
    if (size < sizeof(Front)) return failed(i, "%zu bytes are no state of this FMU", size);
    memcpy(&front, bytes, sizeof(Front));
    if (memcmp(front.token, TOKEN, sizeof(TOKEN)) || front.size != size - sizeof(Front))
        return failed(i, "the %zu bytes are a state of another FMU, or damaged", size);
    void *whole = realloc(*state, size);
    if (!whole) return failed(i, "there is no memory left");
    memcpy(whole, bytes, size);
    *state = whole;
    return fmi3OK;
}

/* -- what there is none of */

/* Further arguments are ignored, as the calling conventions of Linux allow. */
#define NONE(function) \
    fmi3Status function(fmi3Instance i) { return failed(i, #function " is not supported by this FMU"); }

NONE(fmi3GetFloat32)
NONE(fmi3GetInt8)
NONE(fmi3GetUInt8)
NONE(fmi3GetInt16)
NONE(fmi3GetUInt16)
NONE(fmi3GetInt32)
NONE(fmi3GetUInt32)
NONE(fmi3GetInt64)
NONE(fmi3GetUInt64)
NONE(fmi3GetBoolean)
NONE(fmi3GetString)
NONE(fmi3GetBinary)
NONE(fmi3GetClock)
NONE(fmi3SetFloat32)
NONE(fmi3SetInt8)
NONE(fmi3SetUInt8)
NONE(fmi3SetInt16)
NONE(fmi3SetUInt16)
NONE(fmi3SetInt32)
NONE(fmi3SetUInt32)
NONE(fmi3SetInt64)
NONE(fmi3SetUInt64)
NONE(fmi3SetBoolean)
NONE(fmi3SetString)
NONE(fmi3SetBinary)
NONE(fmi3SetClock)
NONE(fmi3GetNumberOfVariableDependencies)
NONE(fmi3GetVariableDependencies)
NONE(fmi3GetDirectionalDerivative)
NONE(fmi3GetAdjointDerivative)
NONE(fmi3EnterConfigurationMode)
NONE(fmi3ExitConfigurationMode)
NONE(fmi3EnterEventMode)
NONE(fmi3GetIntervalDecimal)
NONE(fmi3GetIntervalFraction)
NONE(fmi3GetShiftDecimal)
NONE(fmi3GetShiftFraction)
NONE(fmi3SetIntervalDecimal)
NONE(fmi3SetIntervalFraction)
NONE(fmi3SetShiftDecimal)
NONE(fmi3SetShiftFraction)
NONE(fmi3EvaluateDiscreteStates)
NONE(fmi3UpdateDiscreteStates)
NONE(fmi3EnterContinuousTimeMode)
NONE(fmi3CompletedIntegratorStep)
NONE(fmi3SetTime)
NONE(fmi3SetContinuousStates)
NONE(fmi3GetContinuousStateDerivatives)
NONE(fmi3GetEventIndicators)
NONE(fmi3GetContinuousStates)
NONE(fmi3GetNominalsOfContinuousStates)
NONE(fmi3GetNumberOfEventIndicators)
NONE(fmi3GetNumberOfContinuousStates)
NONE(fmi3EnterStepMode)
NONE(fmi3GetOutputDerivatives)
NONE(fmi3ActivateModelPartition)
