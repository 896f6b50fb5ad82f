/* A testbed in a Python process of its own, with which this talks through a socket.

What stands before this text: PYTHON, the interpreter that exported the FMU; the environment variable VTBDRAKE_PYTHON
names another one. A request is one letter, the number of bytes that follow (8 bytes), and these bytes; so is an answer,
whose letter is '+', or '-' before the sentence of an error. */

#include <errno.h>
#include <spawn.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

extern char **environ;

#define CHILDS_END 3 /* the descriptor of the socket in the child */

struct Model {
    int connection;
    pid_t child;
};

static int sent(int connection, const void *bytes, size_t size) {
    for (const char *at = bytes; size;) {
        ssize_t n = send(connection, at, size, MSG_NOSIGNAL);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) return 0;
        at += n, size -= n;
    }
    return 1;
}

static int received(int connection, void *bytes, size_t size) {
    for (char *at = bytes; size;) {
        ssize_t n = recv(connection, at, size, 0);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) return 0;
        at += n, size -= n;
    }
    return 1;
}

/* Return the answer in memory of its own, one byte longer, or NULL with the message. */
static char *answer(Model *model, char letter, const void *bytes, uint64_t size, uint64_t *length, char *message) {
    char head[9] = {letter}, *reply = NULL;
    memcpy(head + 1, &size, 8);
    int is_alive = sent(model->connection, head, 9) && sent(model->connection, bytes, size) &&
                   received(model->connection, head, 9);
    memcpy(length, head + 1, 8);
    if (is_alive && (reply = calloc(1, *length + 1)) && !received(model->connection, reply, *length)) {
        free(reply);
        reply = NULL;
    }
    if (reply && head[0] == '+') return reply;
    snprintf(message, MESSAGE_SIZE, "%s", reply ? reply : "the Python process of the FMU has ended: see its output");
    free(reply);
    return NULL;
}

static int request(Model *model, char letter, const void *bytes, uint64_t size, char *message) {
    uint64_t length;
    char *reply = answer(model, letter, bytes, size, &length, message);
    free(reply);
    return !reply;
}

static Model *model_new(const char *resources, char *message) {
    int ends[2];
    Model *model = calloc(1, sizeof(Model));
    if (!model || socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, ends)) {
        snprintf(message, MESSAGE_SIZE, "no socket can be made: %s", strerror(errno));
        free(model);
        return NULL;
    }
    const char *python = getenv("VTBDRAKE_PYTHON");
    if (!python || !*python) python = PYTHON;
    char script[4096];
    snprintf(script, sizeof(script), "%s/start.py", resources);
    char *arguments[] = {(char *)python, script, NULL};
    posix_spawn_file_actions_t actions;
    posix_spawn_file_actions_init(&actions);
    posix_spawn_file_actions_adddup2(&actions, ends[1], CHILDS_END);
    int error = posix_spawnp(&model->child, python, &actions, NULL, arguments, environ);
    posix_spawn_file_actions_destroy(&actions);
    close(ends[1]);
    model->connection = ends[0];
    if (error) {
        snprintf(message, MESSAGE_SIZE, "%s cannot be started (%s): name a Python with vtbdrake in VTBDRAKE_PYTHON",
                 python, strerror(error));
        close(ends[0]);
        free(model);
        return NULL;
    }
    if (request(model, 'h', "", 0, message)) {
        model_free(model);
        return NULL;
    }
    return model;
}

static int model_begin(Model *model, double time, char *message) { return request(model, 'b', &time, 8, message); }

static int model_start(Model *model, char *message) { return request(model, 's', "", 0, message); }

static int model_write(Model *model, int first, int size, const double *values, char *message) {
    double numbers[N_VALUES + 1] = {first};
    memcpy(numbers + 1, values, size * sizeof(double));
    return request(model, 'w', numbers, (1 + size) * sizeof(double), message);
}

static int model_outputs(Model *model, double *outputs, char *message) {
    uint64_t length = 0;
    char *reply = answer(model, 'o', "", 0, &length, message);
    if (reply && length == N_OUTPUTS * sizeof(double)) memcpy(outputs, reply, length);
    free(reply);
    return !reply;
}

static int model_advance(Model *model, double end, char *message) { return request(model, 'a', &end, 8, message); }

static void *model_save(Model *model, size_t *size, char *message) {
    uint64_t length = 0;
    char *reply = answer(model, 'g', "", 0, &length, message);
    *size = length;
    return reply;
}

static int model_load(Model *model, const void *state, size_t size, char *message) {
    return request(model, 'l', state, size, message);
}

static void model_free(Model *model) {
    close(model->connection); /* at which the child ends */
    while (waitpid(model->child, NULL, 0) < 0 && errno == EINTR) continue;
    free(model);
}
