/* A compiled testbed: its updates in the order of Drake's Simulator.

What stands before this text: the C code of CasADi with the functions update_... and record, NZ, NW, N_TIMINGS, N_WORK,
N_IWORK, N_ARGUMENTS, N_RESULTS, `z_start`, `places` (where each value that can be set lies in z), `timings`, and
`reasons` (why a trajectory departs from Drake's). */

struct Model {
    double z[NZ];
    double now;
    uint8_t due[N_TIMINGS + 1]; /* which of the updates happen at `now`, when the next step begins */
};

/* Call a function of CasADi: all arguments are dense. */
static void call(Function function, const double **arguments, double *result) {
    const double *in[N_ARGUMENTS];
    double *out[N_RESULTS] = {result};
    casadi_int integers[N_IWORK + 1];
    double work[N_WORK + 1];
    for (int k = 0; arguments[k]; k++) in[k] = arguments[k];
    function(in, out, integers, work, 0);
}

/* There are no random numbers. */
static const double no_noise[NW];

/* The first time of a timing after `now`, as Drake's LeafSystem computes it. */
static double next_time(const Timing *timing, double now) {
    if (now < timing->offset) return timing->offset;
    double k = ceil((now - timing->offset) / timing->period);
    double time = timing->offset + k * timing->period;
    return time > now ? time : timing->offset + (k + 1.0) * timing->period;
}

/* Return the next time after `now` at which updates are due, and mark them. */
static double next_updates(double now, uint8_t *due) {
    double earliest = INFINITY;
    for (int k = 0; k < N_TIMINGS; k++) earliest = fmin(earliest, next_time(&timings[k], now));
    for (int k = 0; k < N_TIMINGS; k++) due[k] = next_time(&timings[k], now) == earliest;
    return earliest;
}

static Model *model_new(const char *resources, char *message) {
    (void)resources;
    Model *model = calloc(1, sizeof(Model));
    if (!model) snprintf(message, MESSAGE_SIZE, "there is no memory left");
    return model;
}

static int model_begin(Model *model, double time, char *message) {
    (void)message;
    memcpy(model->z, z_start, sizeof(model->z));
    model->now = time;
    if (next_updates(nextafter(time, -INFINITY), model->due) > time) memset(model->due, 0, sizeof(model->due));
    return 0;
}

static int model_start(Model *model, char *message) {
    (void)model, (void)message;
    return 0;
}

static int model_write(Model *model, int first, int size, const double *values, char *message) {
    (void)message;
    for (int k = 0; k < size; k++) model->z[places[first + k]] = values[k];
    return 0;
}

static int model_outputs(Model *model, double *outputs, char *message) {
    double recorded[N_OUTPUTS + 2]; /* behind the outputs: the time of the doubt, and the number of its reason */
    const double *arguments[] = {model->z, &model->now, no_noise, NULL};
    call(record, arguments, recorded);
    int doubt = (int)recorded[N_OUTPUTS + 1];
    if (doubt > 0) {
        snprintf(message, MESSAGE_SIZE, "%s at t = %.9g s, which is not compiled: export the FMU with kind='coupled'",
                 reasons[doubt - 1], recorded[N_OUTPUTS]);
        return 1;
    }
    memcpy(outputs, recorded, N_OUTPUTS * sizeof(double));
    return 0;
}

/* Make the updates that are due: the unrestricted ones first; all of one kind begin with the same z. */
static void update(Model *model) {
    double before[NZ], following[NZ];
    for (int unrestricted = 1; unrestricted >= 0; unrestricted--) {
        memcpy(before, model->z, sizeof(before));
        for (int k = 0; k < N_TIMINGS; k++) {
            if (!model->due[k] || timings[k].unrestricted != unrestricted) continue;
            const double *arguments[] = {before, model->z, &model->now, no_noise, NULL};
            call(updates[k], arguments, following);
            memcpy(model->z, following, sizeof(following));
        }
    }
}

/* Return the time of the update that coincides with the end of a step up to rounding, or the end. */
static double instant(double end) {
    double close = 8.0 * (nextafter(fmax(fabs(end), 1.0), INFINITY) - fmax(fabs(end), 1.0)), first = INFINITY;
    for (int k = 0; k < N_TIMINGS; k++) {
        double event = timings[k].offset + fmax(rint((end - timings[k].offset) / timings[k].period), 0.0) * timings[k].period;
        if (fabs(event - end) <= close) first = fmin(first, event);
    }
    return isfinite(first) ? first : end;
}

static int model_advance(Model *model, double end, char *message) {
    end = instant(end);
    while (model->now < end) {
        update(model);
        double following = next_updates(model->now, model->due);
        if (following > end) memset(model->due, 0, sizeof(model->due));
        model->now = fmin(following, end);
    }
    double outputs[N_OUTPUTS + 1];
    return model_outputs(model, outputs, message);
}

static void *model_save(Model *model, size_t *size, char *message) {
    Model *state = malloc(sizeof(Model));
    *size = sizeof(Model);
    if (state)
        memcpy(state, model, sizeof(Model));
    else
        snprintf(message, MESSAGE_SIZE, "there is no memory left");
    return state;
}

static int model_load(Model *model, const void *state, size_t size, char *message) {
    if (size != sizeof(Model)) {
        snprintf(message, MESSAGE_SIZE, "the state has %zu bytes instead of %zu", size, sizeof(Model));
        return 1;
    }
    memcpy(model, state, sizeof(Model));
    return 0;
}

static void model_free(Model *model) { free(model); }
