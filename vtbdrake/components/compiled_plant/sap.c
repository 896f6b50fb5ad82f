/* One step of a discrete plant, by the SAP solver of Drake (Castro, Permenter, Han 2022, arXiv:2110.10107).

The velocities v after the step minimize

    1/2 (v - v*)' A (v - v*) + sum over contacts l(J v) + sum over axes l(v_i),

by Newton's method with an exact line search. Iterations begin, proceed and end as Drake's do, at an error of 1e-6 of the
momentum: what is left of it is the same, too, and does not drive apart what is sensitive. A = M + dt D is factored as
L' L along the tree of velocities (Featherstone, RBDA, 6.3): WAY[0] tells the velocities next to each on the way to the
root. So is the Hessian A + sum J' G J, unless a contact between two branches of the tree is active: then along WAY[1],
longer ways on which every contact moves with velocities of one. Contact models are those of Drake's discrete plant,

    SAP:    impulses projected onto the friction cone, with a compliance at least that of near-rigid contact;
    LAGGED: Hunt and Crossley's normal force, and regularized friction under the normal force before the step.

The frame of a contact has its z along the normal, from body 1 into body 2; velocities are those of 2 against 1.

An axis is an impulse on one velocity that falls linearly with it, between two bounds. Stops of joints (Drake's
SapLimitConstraint) and PD controllers of actuators with their effort limits (SapPdControllerConstraint) are axes.

The text before this one defines NAME; NV, NB, NC, NS, ND: the numbers of velocities, bodies that may touch, contacts,
joints with stops and actuators with a controller; LAGGED: 0 or 1; DT: the time step (s); BETA: the near-rigid threshold;
VS: the stiction tolerance (m/s); WAY[2][NV][NV] and their lengths DEPTH[2][NV]; TREE[NV]: the number of the tree of
joints, below NV, that a velocity belongs to; SIDES[NC][2]: the bodies 1 and 2 of a contact, -1 for one that is fixed;
COUNT[NC] and COLUMNS[NC][NV]: the velocities that move a contact; IS_BETWEEN[NC]: whether it is between two branches;
STOP[NS]: the velocity of a joint with stops, LOWER[NS] and UPPER[NS] (rad or m); DRIVE[ND]: the velocity of an actuator,
KP[ND], KD[ND] and EFFORT[ND] (N m or N). Tables have a row more, because C has no empty ones.

Arguments, by columns: A (NV, NV), p* = A v* (NV), the velocities before the step (NV), of the bodies the angular and the
linear Jacobian (6 NB, NV) in the world, normals (3, NC), distances (NC, m, below 0 in contact), stiffness (NC, N/m),
dissipation (NC: SAP's time in s, or LAGGED's in s/m), friction (NC); the positions of the joints with stops (NS); of the
controllers KP (q_d - q) + KD v_d (ND), with the position before the step, and the feed-forward actuation (ND); the
origins of the bodies (3, NB) and the points of contact (3, NC) in the world (m).
Results: v (NV); forces on bodies 2 in the world (3, NC, N); the actuation of the controllers (ND, N m or N); and a doubt:
1 where the iteration did not converge, else 0. */

#pragma GCC optimize("O3") /* 3 % faster than O2 */

#include <math.h>
#include <string.h>

#define ARGUMENTS 14
/* Numbers of Drake's SapSolver. */
#define MOST_ITERATIONS 100     /* also of a line search */
#define TOLERANCE 1e-6          /* of the momentum */
#define LONGEST_STEP 1.5        /* of a line search */
#define SLOPE_TOLERANCE 1e-8    /* of a line search, against its first slope */
#define SOFT_TOLERANCE 1e-7     /* N s, of the norm of SAP's tangential impulse */
#define SIGMA 1e-3
/* Of stops and controllers, in Drake: the near-rigid threshold, and the stiffness of a stop (N/m or N m/rad). */
#define NEAR_RIGID (0.1 * 0.1 / (4.0 * M_PI * M_PI))
#define STOP_STIFFNESS 1e12

typedef struct {
    int at;                     /* its number among all */
    int count;                  /* of the velocities that move it, */
    const int *columns;         /* which are these */
    double J[3][NV];            /* in the contact's frame, a column for each of them */
    double R_WC[3][3];          /* columns: two tangents, the normal */
    double mu, k, d, phi;
    double Gt, Gn, vn_hat;      /* SAP: 1 / R of the tangents and the normal (N s^2/m), and where the latter is at rest, */
    double mu_hat, slide;       /* mu Rt / Rn, and 1 / (1 + mu mu_hat) */
    double n0, eps;             /* LAGGED */
    double vc[3], G[3][3];      /* of the last gradient: its velocity, and what its impulse falls by with it */
} Contact;

typedef struct {
    int v;                      /* the velocity that it acts on */
    double at_rest, slope;      /* the impulse is at_rest - slope v_v, */
    double low, high;           /* but within these */
    int is_near_rigid;          /* whether the impulse grows with A_vv, */
    double feed_forward;        /* but for this part */
    int number;                 /* of the joint with stops, or of the controller */
} Axis;

typedef struct {
    double A[NV][NV], v_star[NV], scale[NV]; /* scale is 1 / diag A */
    Contact contacts[NC + 1];
    Axis axes[2 * NS + ND + 1];
    int contact_count, axis_count;
    int takes_part[NV];                      /* by tree: whether it has a contact or an axis; else, v = v* there */
    int ways;                                /* of the Hessian: 1 if an active contact is between two branches */
} Problem;

/* Factor H = L' L in place, along WAY[ways]; the diagonal becomes 1 / L_kk. Return 0 if H is not positive definite. */
static int factor(double (*H)[NV], int ways) {
    const int *depth = DEPTH[ways];
    for (int k = NV - 1; k >= 0; --k) {
        if (!(H[k][k] > 0.0)) return 0;
        double row[NV], scale = H[k][k] = 1.0 / sqrt(H[k][k]);
        for (int a = 0; a < depth[k]; ++a) row[a] = H[k][WAY[ways][k][a]] *= scale;
        for (int a = 0; a < depth[k]; ++a) {
            double *below = H[WAY[ways][k][a]];
            for (int b = a; b < depth[k]; ++b) below[WAY[ways][k][b]] -= row[a] * row[b];
        }
    }
    return 1;
}

static void solve(double (*L)[NV], int ways, double *x) {
    const int *depth = DEPTH[ways];
    for (int i = NV - 1; i >= 0; --i) {
        x[i] *= L[i][i];
        for (int a = 0; a < depth[i]; ++a) x[WAY[ways][i][a]] -= L[i][WAY[ways][i][a]] * x[i];
    }
    for (int i = 0; i < NV; ++i) {
        for (int a = 0; a < depth[i]; ++a) x[i] -= L[i][WAY[ways][i][a]] * x[WAY[ways][i][a]];
        x[i] *= L[i][i];
    }
}

/* y = A x, along the tree of joints. */
static void multiply(double (*A)[NV], const double *x, double *y) {
    memset(y, 0, NV * sizeof *y);
    for (int i = 0; i < NV; ++i) {
        double sum = A[i][i] * x[i];
        for (int a = 0; a < DEPTH[0][i]; ++a) {
            int j = WAY[0][i][a];
            sum += A[i][j] * x[j];
            y[j] += A[i][j] * x[i];
        }
        y[i] += sum;
    }
}

static double dot(const double *x, const double *y) {
    double sum = 0.0;
    for (int i = 0; i < NV; ++i) sum += x[i] * y[i];
    return sum;
}

/* The frame of a normal n, as Drake's RotationMatrix::MakeFromOneVector. */
static void frame(const double *n, double (*R)[3]) {
    int i = fabs(n[0]) <= fabs(n[1]) ? (fabs(n[0]) <= fabs(n[2]) ? 0 : 2) : (fabs(n[1]) <= fabs(n[2]) ? 1 : 2);
    int j = (i + 1) % 3, k = (i + 2) % 3;
    double r = sqrt(n[j] * n[j] + n[k] * n[k]);
    R[i][0] = 0.0;
    R[j][0] = -n[k] / r;
    R[k][0] = n[j] / r;
    for (int a = 0; a < 3; ++a) {
        int b = (a + 1) % 3, c = (a + 2) % 3;
        R[a][1] = n[b] * R[c][0] - n[c] * R[b][0];
        R[a][2] = n[a];
    }
}

static void contact_velocity(const Contact *c, const double *v, double *vc) {
    vc[0] = vc[1] = vc[2] = 0.0;
    for (int m = 0; m < c->count; ++m)
        for (int r = 0; r < 3; ++r) vc[r] += c->J[r][m] * v[c->columns[m]];
}

/* The impulse g at the velocity vc, and G = -dg/dvc, symmetric. */
static void impulse(const Contact *c, const double *vc, double *g, double (*G)[3]) {
    memset(G, 0, 9 * sizeof(double));
#if LAGGED
    double soft = sqrt(vc[0] * vc[0] + vc[1] * vc[1] + c->eps * c->eps);
    double t[2] = {vc[0] / soft, vc[1] / soft};
    double fe = -c->k * (c->phi + DT * vc[2]), damping = 1.0 - c->d * vc[2];
    g[0] = -c->mu * c->n0 * t[0];
    g[1] = -c->mu * c->n0 * t[1];
    g[2] = 0.0;
    if (fe > 0.0 && damping > 0.0) {
        g[2] = DT * fe * damping;
        G[2][2] = DT * (c->k * DT * damping + c->d * fe);
    }
    for (int r = 0; r < 2; ++r)
        for (int s = 0; s < 2; ++s) G[r][s] = c->mu * c->n0 * ((r == s) - t[r] * t[s]) / soft;
#else
    double y[3] = {-vc[0] * c->Gt, -vc[1] * c->Gt, (c->vn_hat - vc[2]) * c->Gn};
    double yr = sqrt(y[0] * y[0] + y[1] * y[1] + SOFT_TOLERANCE * SOFT_TOLERANCE);
    if (yr <= c->mu * y[2]) { /* it sticks */
        memcpy(g, y, 3 * sizeof *g);
        G[0][0] = G[1][1] = c->Gt;
        G[2][2] = c->Gn;
    } else if (-c->mu_hat * yr < y[2]) { /* it slides */
        double t[2] = {y[0] / yr, y[1] / yr};
        g[2] = c->slide * (y[2] + c->mu_hat * yr);
        for (int r = 0; r < 2; ++r) {
            g[r] = c->mu * g[2] * t[r];
            G[r][2] = G[2][r] = c->mu * c->slide * t[r] * c->Gn;
            for (int s = 0; s < 2; ++s)
                G[r][s] = c->mu * c->Gt * (g[2] / yr * ((r == s) - t[r] * t[s]) + c->mu_hat * c->slide * t[r] * t[s]);
        }
        G[2][2] = c->slide * c->Gn;
    } else {
        g[0] = g[1] = g[2] = 0.0;
    }
#endif
}

/* The impulse of an axis at its velocity v, and the slope with which it falls. */
static double axis_impulse(const Axis *a, double v, double *slope) {
    double g = a->at_rest - a->slope * v;
    *slope = 0.0;
    if (g <= a->low) return a->low;
    if (g >= a->high) return a->high;
    *slope = a->slope;
    return g;
}

/* What does not change in the iteration; v0 are the velocities before the step. */
static void prepare(Contact *c, const double *scale, const double *v0) {
    double square = 0.0;
    for (int r = 0; r < 3; ++r)
        for (int s = 0; s <= r; ++s) {
            double entry = 0.0;
            for (int m = 0; m < c->count; ++m) entry += c->J[r][m] * c->J[s][m] * scale[c->columns[m]];
            square += (s < r ? 2.0 : 1.0) * entry * entry;
        }
    double w = sqrt(square) / 3.0; /* Drake's estimate of J A^-1 J', by the diagonal of A */
    double Rt = SIGMA * w;
#if LAGGED
    double vc[3];
    contact_velocity(c, v0, vc);
    c->n0 = fmax(0.0, -DT * c->k * c->phi) * fmax(0.0, 1.0 - c->d * vc[2]);
    c->eps = fmax(VS, c->mu * Rt * c->n0);
#else
    (void)v0;
    double near_rigid = BETA * BETA / (4.0 * M_PI * M_PI) * w;
    double Rn = fmax(near_rigid, 1.0 / (DT * c->k * (DT + c->d)));
    c->Gt = 1.0 / Rt, c->Gn = 1.0 / Rn, c->mu_hat = c->mu * Rt / Rn, c->slide = 1.0 / (1.0 + c->mu * c->mu_hat);
    c->vn_hat = -c->phi / (DT + c->d);
#endif
}

/* The velocity of body 2 against body 1 at a contact for each unit of the velocity i, in the world. */
static void column(const double *const *in, int at, int i, double *J) {
    memset(J, 0, 3 * sizeof *J);
    for (int side = 0; side < 2; ++side) {
        int body = SIDES[at][side];
        if (body < 0) continue;
        const double *w = in[3] + 6 * body + 6 * NB * i, *v = w + 3, *origin = in[12] + 3 * body, *point = in[13] + 3 * at;
        double sign = side ? 1.0 : -1.0, r[3];
        for (int k = 0; k < 3; ++k) r[k] = point[k] - origin[k];
        J[0] += sign * (v[0] + w[1] * r[2] - w[2] * r[1]);
        J[1] += sign * (v[1] + w[2] * r[0] - w[0] * r[2]);
        J[2] += sign * (v[2] + w[0] * r[1] - w[1] * r[0]);
    }
}

static void add_contacts(Problem *p, const double *const *in, const double *v0) {
    for (int at = 0; at < NC; ++at) {
        if (!(in[5][at] <= 0.0)) continue;
        Contact *c = p->contacts + p->contact_count++;
        c->at = at, c->count = COUNT[at], c->columns = COLUMNS[at];
        c->phi = in[5][at], c->k = in[6][at], c->d = in[7][at], c->mu = in[8][at];
        frame(in[4] + 3 * at, c->R_WC);
        for (int m = 0; m < c->count; ++m) {
            double J[3];
            column(in, at, c->columns[m], J);
            for (int r = 0; r < 3; ++r) c->J[r][m] = c->R_WC[0][r] * J[0] + c->R_WC[1][r] * J[1] + c->R_WC[2][r] * J[2];
        }
        prepare(c, p->scale, v0);
        p->ways |= IS_BETWEEN[at];
    }
}

/* Add the stops that lie within twice the motion of a step, as Drake does; its dissipation time is the step. */
static void add_stops(Problem *p, const double *v0, const double *q) {
    for (int s = 0; s < NS; ++s) {
        int i = STOP[s];
        double reach = 2.0 * DT * fmax(fabs(v0[i]), fabs(p->v_star[i]));
        double near_rigid = NEAR_RIGID * p->scale[i], R = fmax(near_rigid, 1.0 / (DT * STOP_STIFFNESS * (2.0 * DT)));
        Axis stop = {.v = i, .slope = 1.0 / R, .is_near_rigid = R == near_rigid, .number = s};
        if (LOWER[s] >= q[s] - reach) {
            stop.at_rest = (LOWER[s] - q[s]) / (2.0 * DT) / R, stop.low = 0.0, stop.high = INFINITY;
            p->axes[p->axis_count++] = stop;
        }
        if (UPPER[s] <= q[s] + reach) {
            stop.at_rest = (UPPER[s] - q[s]) / (2.0 * DT) / R, stop.low = -INFINITY, stop.high = 0.0;
            p->axes[p->axis_count++] = stop;
        }
    }
}

/* Add the controllers; gains that the step does not resolve are scaled down to near-rigid ones, as in Drake. */
static void add_drives(Problem *p, const double *pull, const double *feed_forward) {
    for (int d = 0; d < ND; ++d) {
        int i = DRIVE[d];
        double gain = DT * (DT * KP[d] + KD[d]), share = fmin(1.0, 1.0 / (gain * NEAR_RIGID * p->scale[i]));
        p->axes[p->axis_count++] = (Axis){
            .v = i, .at_rest = DT * (share * pull[d] + feed_forward[d]), .slope = share * gain, .low = -DT * EFFORT[d],
            .high = DT * EFFORT[d], .is_near_rigid = share < 1.0, .feed_forward = DT * feed_forward[d], .number = d};
    }
}

/* What tells whether the iteration has converged, as in Drake. */
typedef struct {
    double gradient, momentum, impulses;
} Norms;

/* The gradient of the cost at v, and its norms. */
static Norms gradient(Problem *p, const double *p_star, const double *v, double *grad) {
    double d[NV], impulses[NV] = {0.0}, slope;
    Norms norms = {0.0, 0.0, 0.0};
    for (int a = 0; a < p->contact_count; ++a) {
        Contact *c = p->contacts + a;
        double g[3];
        contact_velocity(c, v, c->vc);
        impulse(c, c->vc, g, c->G);
        for (int m = 0; m < c->count; ++m)
            impulses[c->columns[m]] += c->J[0][m] * g[0] + c->J[1][m] * g[1] + c->J[2][m] * g[2];
    }
    for (int a = 0; a < p->axis_count; ++a)
        impulses[p->axes[a].v] += axis_impulse(p->axes + a, v[p->axes[a].v], &slope);
    for (int i = 0; i < NV; ++i) d[i] = v[i] - p->v_star[i];
    multiply(p->A, d, grad);
    for (int i = 0; i < NV; ++i) {
        double momentum = grad[i] + p_star[i];
        grad[i] -= impulses[i];
        norms.impulses += impulses[i] * impulses[i] * p->scale[i];
        if (!p->takes_part[TREE[i]]) continue;
        norms.gradient += grad[i] * grad[i] * p->scale[i];
        norms.momentum += momentum * momentum * p->scale[i];
    }
    return norms;
}

/* The Hessian of the cost at v, where its gradient was taken last; its lower half. */
static void hessian(const Problem *p, const double *v, double (*H)[NV]) {
    memcpy(H, p->A, sizeof p->A);
    for (int a = 0; a < p->contact_count; ++a) {
        const Contact *c = p->contacts + a;
        double W[3][NV];
        for (int m = 0; m < c->count; ++m)
            for (int r = 0; r < 3; ++r)
                W[r][m] = c->G[r][0] * c->J[0][m] + c->G[r][1] * c->J[1][m] + c->G[r][2] * c->J[2][m];
        for (int m = 0; m < c->count; ++m) { /* columns increase */
            double *row = H[c->columns[m]];
            for (int l = 0; l <= m; ++l)
                row[c->columns[l]] += c->J[0][m] * W[0][l] + c->J[1][m] * W[1][l] + c->J[2][m] * W[2][l];
        }
    }
    for (int a = 0; a < p->axis_count; ++a) {
        int i = p->axes[a].v;
        double slope;
        axis_impulse(p->axes + a, v[i], &slope);
        H[i][i] += slope;
    }
}

/* A direction from v, and what is needed for the slope of the cost along it. */
typedef struct {
    double v[NV], direction[NV], Ap[NV], dAp, pAp;
    double along[NC + 1][3];    /* the same of contacts */
} Line;

/* Return the slope of the cost after a step along a line, and its curvature. */
static double slope_after(const Problem *p, const Line *line, double step, double *curvature) {
    double slope = line->dAp + step * line->pAp;
    *curvature = line->pAp;
    for (int a = 0; a < p->contact_count; ++a) {
        const double *along = line->along[a];
        double vc[3], g[3], G[3][3];
        for (int r = 0; r < 3; ++r) vc[r] = p->contacts[a].vc[r] + step * along[r];
        impulse(p->contacts + a, vc, g, G);
        for (int r = 0; r < 3; ++r) {
            slope -= g[r] * along[r];
            for (int s = 0; s < 3; ++s) *curvature += along[r] * G[r][s] * along[s];
        }
    }
    for (int a = 0; a < p->axis_count; ++a) {
        int i = p->axes[a].v;
        double along = line->direction[i], falls;
        slope -= axis_impulse(p->axes + a, line->v[i] + step * along, &falls) * along;
        *curvature += falls * along * along;
    }
    return slope;
}

/* Return the step at which the cost is least, by Newton's method with bisection (rtsafe); NaN if there is none. */
static double line_search(Problem *p, Line *line, double slope0) {
    double curvature, d[NV];
    multiply(p->A, line->direction, line->Ap);
    for (int i = 0; i < NV; ++i) d[i] = line->v[i] - p->v_star[i];
    line->dAp = dot(d, line->Ap), line->pAp = dot(line->direction, line->Ap);
    for (int a = 0; a < p->contact_count; ++a) contact_velocity(p->contacts + a, line->direction, line->along[a]);
    if (!(slope0 < 0.0)) return NAN;
    if (slope_after(p, line, LONGEST_STEP, &curvature) < SLOPE_TOLERANCE * -slope0) return LONGEST_STEP;
    double step = fmin(-slope0 / curvature, LONGEST_STEP), tolerance = SLOPE_TOLERANCE * step;
    double low = 0.0, high = LONGEST_STEP, change = high, before = high;
    for (int k = 0; k < MOST_ITERATIONS; ++k) {
        double slope = slope_after(p, line, step, &curvature);
        if (slope < 0.0) low = step;
        else high = step;
        if (fabs(slope) < SLOPE_TOLERANCE * -slope0) return step;
        int is_slow = 2.0 * fabs(slope) > fabs(before * curvature);
        double next = step - slope / curvature;
        before = change;
        if (is_slow || !(low <= next && next <= high)) {
            change = 0.5 * (high - low);
            step = low + change;
        } else {
            change = slope / curvature;
            step = next;
        }
        if (fabs(change) < tolerance) return step;
    }
    return NAN;
}

/* Iterate from the velocities before the step; return whether it converges. */
static int minimize(Problem *p, const double *p_star, double *v) {
    double H[NV][NV], grad[NV];
    Line line;
    for (int i = 0; i < NV; ++i)
        if (!p->takes_part[TREE[i]]) v[i] = p->v_star[i];
    for (int k = 0; k <= MOST_ITERATIONS; ++k) {
        Norms norms = gradient(p, p_star, v, grad);
        if (!isfinite(norms.momentum + norms.impulses)) return 0;
        if (sqrt(norms.gradient) <= 1e-14 + TOLERANCE * sqrt(fmax(norms.momentum, norms.impulses))) return 1;
        if (k == MOST_ITERATIONS) return 0;
        hessian(p, v, H);
        if (!factor(H, p->ways)) return 0;
        for (int i = 0; i < NV; ++i) line.direction[i] = -grad[i];
        solve(H, p->ways, line.direction);
        memcpy(line.v, v, sizeof line.v);
        double step = line_search(p, &line, dot(grad, line.direction));
        if (!(step > 0.0)) return 0;
        for (int i = 0; i < NV; ++i) v[i] += step * line.direction[i];
    }
    return 0;
}

static void write_forces(const Problem *p, const double *v, double *forces) {
    memset(forces, 0, 3 * NC * sizeof *forces);
    for (int a = 0; a < p->contact_count; ++a) {
        const Contact *c = p->contacts + a;
        double vc[3], g[3], G[3][3];
        contact_velocity(c, v, vc);
        impulse(c, vc, g, G);
        for (int r = 0; r < 3; ++r)
            forces[3 * c->at + r] = (c->R_WC[r][0] * g[0] + c->R_WC[r][1] * g[1] + c->R_WC[r][2] * g[2]) / DT;
    }
}

/* Set up the problem of one step from the arguments, and solve it; return whether that worked. */
static int take_step(const double **arg, Problem *p, double *v) {
    static const double none[3 * NC + 6 * NB * NV + NV * NV + NS + ND + 1] = {0.0};
    const double *in[ARGUMENTS];
    for (int i = 0; i < ARGUMENTS; ++i) in[i] = arg[i] ? arg[i] : none; /* CasADi's way to say that all are zero */
    double L[NV][NV];
    p->contact_count = p->axis_count = p->ways = 0;
    memcpy(p->A, in[0], sizeof p->A); /* symmetric */
    for (int i = 0; i < NV; ++i) p->scale[i] = 1.0 / p->A[i][i];
    memcpy(L, p->A, sizeof L);
    memcpy(p->v_star, in[1], sizeof p->v_star);
    memcpy(v, in[2], sizeof p->v_star);
    if (!factor(L, 0)) return 0;
    solve(L, 0, p->v_star);
    add_contacts(p, in, in[2]);
    add_stops(p, in[2], in[9]);
    add_drives(p, in[10], in[11]);
    if (p->contact_count + p->axis_count) {
        memset(p->takes_part, 0, sizeof p->takes_part);
        for (int a = 0; a < p->contact_count; ++a)
            for (int m = 0; m < p->contacts[a].count; ++m) p->takes_part[TREE[p->contacts[a].columns[m]]] = 1;
        for (int a = 0; a < p->axis_count; ++a) p->takes_part[TREE[p->axes[a].v]] = 1;
        return minimize(p, in[1], v);
    }
    memcpy(v, p->v_star, sizeof p->v_star);
    return 1;
}

int NAME(const double **arg, double **res, long long int *iw, double *w, int mem) {
    (void)iw, (void)w, (void)mem;
    Problem p;
    double v[NV], slope;
    int converged = take_step(arg, &p, v);
    if (res[0]) memcpy(res[0], v, sizeof v);
    if (res[1]) write_forces(&p, v, res[1]);
    const Axis *drives = p.axes + p.axis_count - ND; /* the last axes */
    for (int d = 0; res[2] && d < ND; ++d)
        res[2][d] = p.axis_count ? axis_impulse(drives + d, v[drives[d].v], &slope) / DT : 0.0;
    if (res[3]) *res[3] = converged ? 0.0 : 1.0;
    return 0;
}
