/* The derivative of a step without contact, by the theorem of implicit functions:

    H dv = dp* - dA v + sum over axes of their impulse's derivative at constant v

with the Hessian H of the cost at the solution. It follows sap.c, and the text before it defines JACOBIAN, its name.

Arguments: those of the step, and its results. Results: for each result of the step, in order, its derivatives with
respect to each argument, by columns. */

/* What the impulse of an axis grows by with its number among the arguments, at constant velocity. */
static double by_argument(const Axis *a, int is_drive) {
    return is_drive ? DT * a->slope / (DT * (DT * KP[a->number] + KD[a->number])) : -a->slope / (2.0 * DT);
}

/* Write the derivatives of an entry of the results, given those with respect to the momentum, and its own by an axis. */
static void write_row(const Problem *p, const double *v, const double *by_momentum, const Axis *own, double **res, int row,
                      int rows) {
    double slope;
    if (res[1])
        for (int i = 0; i < NV; ++i) res[1][row + rows * i] = by_momentum[i];
    if (res[0])
        for (int i = 0; i < NV; ++i)
            for (int j = 0; j < NV; ++j) res[0][row + rows * (i + NV * j)] = -by_momentum[i] * v[j];
    for (int a = 0; a < p->axis_count; ++a) {
        const Axis *axis = p->axes + a;
        double g = axis_impulse(axis, v[axis->v], &slope), weight = by_momentum[axis->v];
        if (slope == 0.0) continue; /* at a bound */
        if (axis == own) weight += 1.0 / DT;
        int is_drive = a >= p->axis_count - ND;
        if (res[0] && axis->is_near_rigid)
            res[0][row + rows * (axis->v + NV * axis->v)] += weight * (g - axis->feed_forward) * p->scale[axis->v];
        double *result = is_drive ? res[10] : res[9];
        if (result) result[row + rows * axis->number] += weight * by_argument(axis, is_drive);
        if (is_drive && res[11]) res[11][row + rows * axis->number] += weight * DT;
    }
}

int JACOBIAN(const double **arg, double **res, long long int *iw, double *w, int mem) {
    (void)iw, (void)w, (void)mem;
    static const int sizes[ARGUMENTS] = {NV * NV, NV, NV, 0, 0, 0, 0, 0, 0, NS, ND, ND};
    static const int rows[4] = {NV, 0, ND, 1};
    Problem p;
    double v[NV], H[NV][NV], slope;
    take_step(arg, &p, v);
    hessian(&p, v, H);
    int works = factor(H, p.ways);
    for (int o = 0; o < 4; ++o) {
        double **block = res + ARGUMENTS * o;
        for (int i = 0; i < ARGUMENTS; ++i)
            if (block[i]) memset(block[i], 0, sizeof(double) * rows[o] * sizes[i]);
        for (int row = 0; works && o != 3 && row < rows[o]; ++row) {
            double by_momentum[NV] = {0.0};
            const Axis *drive = o == 2 ? p.axes + p.axis_count - ND + row : 0;
            if (drive) axis_impulse(drive, v[drive->v], &slope);
            by_momentum[drive ? drive->v : row] = drive ? -slope / DT : 1.0;
            solve(H, p.ways, by_momentum);
            write_row(&p, v, by_momentum, drive, block, row, rows[o]);
        }
    }
    return 0;
}
