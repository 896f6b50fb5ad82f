/* Spheres on many fixed shapes, such as the pieces of a terrain: the places where they touch. mpr.c goes before it.

A grid over the map tells which shapes may lie under a sphere. Contact with a box has a closed form, with a hull it is
Drake's iteration.

The text before both defines NAME and SET: names of functions; NF: the number of spheres; RADIUS[NF] (m); SPHERE_ID[NF]; SLOTS: the most contacts of a sphere; MOST_TERRAINS; and the arrays of one terrain, of N shapes, that is number 0. Other
terrains are data: SET gives them a number, or takes it away again.

Arguments: the rotations of the spheres in the world (3, 3 NF) by columns, their centres (3, NF, m), and the number of the
terrain. Results, SLOTS for each sphere: the distance (m, below 0 in contact, else above), the normal from the sphere into
the shape (3), the point of contact less the centre of the sphere (3, m), in the world, stiffness, dissipation and friction;
and a doubt: 1 where a sphere has more contacts, or no terrain has the number, else 0. */

/* For each shape n: IS_BOX, HALF (m, of a box), POSE: its rotation by columns and its position (m), CENTER (m, in its
frame), REACH: the largest distance from the center (m), LOW and HIGH: its box in the world (m), ID: the rank of
Drake's number of the geometry, which tells which shape comes first; the vertices VERTICES[FIRST[n]] to VERTICES[FIRST[n + 1] - 1] (m, in its
frame); MATERIALS[f N + n] of the sphere f: stiffness (N/m), dissipation, friction, and the share of the sphere in the
stiffness. The grid: ORIGIN and CELL (m), NX NY cells, and the shapes CELL_SHAPES[CELL_FIRST[c]] to
CELL_SHAPES[CELL_FIRST[c + 1] - 1] of the cell c = ix + NX iy. */
typedef struct {
    const long long *id, *is_box, *first, *cell_first, *cell_shapes;
    const double (*half)[3], (*pose)[12], (*center)[3], *reach, (*low)[3], (*high)[3], (*vertices)[3], (*materials)[4];
    double origin[2], cell;
    long long count, nx, ny;
} Terrain;

static const Terrain OWN = {ID,   IS_BOX, FIRST, CELL_FIRST, CELL_SHAPES, HALF,      POSE,
                            CENTER, REACH,  LOW,   HIGH,       VERTICES,    MATERIALS, {ORIGIN_X, ORIGIN_Y},
                            CELL, N,      NX,    NY};
static const Terrain *terrains[MOST_TERRAINS] = {&OWN};

/* Give a terrain a number, which must be free: from 1 to MOST_TERRAINS - 1. No pointer: the number is free again. */
void SET(long long number, const Terrain *terrain) { terrains[number] = terrain; }

typedef struct {
    double distance, normal[3], offset[3];
} Touch;

/* The contact of a sphere with a box, by the nearest point of the box. */
static int touch_box(const Terrain *t, const double *center, double radius, long long n, double share, Touch *touch) {
    double apart[3], p[3], out[3], length = 0.0, depth = INFINITY, distance, normal[3];
    int face = 0;
    subtract(center, t->pose[n] + 9, apart);
    for (int k = 0; k < 3; ++k) {
        p[k] = dot(t->pose[n] + 3 * k, apart);
        out[k] = p[k] - fmin(fmax(p[k], -t->half[n][k]), t->half[n][k]);
        length += out[k] * out[k];
        double below = t->half[n][k] - fabs(p[k]);
        if (below < depth) depth = below, face = k;
    }
    length = sqrt(length);
    if (depth >= 0.0) { /* the centre is inside */
        distance = -depth;
        for (int k = 0; k < 3; ++k) out[k] = k == face ? (p[k] < 0.0 ? -1.0 : 1.0) : 0.0;
    } else {
        distance = length;
        for (int k = 0; k < 3; ++k) out[k] /= length;
    }
    distance -= radius;
    if (!(distance <= 0.0)) return 0;
    for (int r = 0; r < 3; ++r) normal[r] = t->pose[n][r] * out[0] + t->pose[n][r + 3] * out[1] + t->pose[n][r + 6] * out[2];
    touch->distance = distance;
    for (int k = 0; k < 3; ++k) {
        double on_sphere = -radius * normal[k], on_box = on_sphere - distance * normal[k];
        touch->normal[k] = -normal[k];
        touch->offset[k] = share * on_sphere + (1.0 - share) * on_box;
    }
    return 1;
}

/* The contact of a sphere with a hull, as Drake iterates. */
static int touch_hull(const Terrain *t, const double *R, const double *center, int f, long long n, double share, Touch *touch) {
    static const double origin[3] = {0.0, 0.0, 0.0};
    double size[3] = {RADIUS[f], 0.0, 0.0}, normal[3], point[3];
    Shape sphere = {SPHERE, 1, size, &origin, origin, R, center};
    Shape hull = {HULL, (int)(t->first[n + 1] - t->first[n]), size, t->vertices + t->first[n], t->center[n], t->pose[n], t->pose[n] + 9};
    int is_first = SPHERE_ID[f] < t->id[n];
    Shape shapes[2] = {is_first ? sphere : hull, is_first ? hull : sphere};
    double middle[3], apart[3], reach = t->reach[n] + 1.001 * RADIUS[f];
    into_world(&hull, t->center[n], middle);
    subtract(middle, center, apart);
    if (dot(apart, apart) > reach * reach) return 0;
    double depth = penetration(shapes, normal, point), of_first = is_first ? share : 1.0 - share;
    if (depth < 0.0) return 0;
    touch->distance = -depth;
    for (int k = 0; k < 3; ++k) {
        double on_first = point[k] + depth / 2.0 * normal[k], on_second = on_first - depth * normal[k];
        touch->normal[k] = is_first ? normal[k] : -normal[k];
        touch->offset[k] = of_first * on_first + (1.0 - of_first) * on_second - center[k];
    }
    return 1;
}

static int is_near(const Terrain *t, const double *center, double radius, long long n) {
    for (int k = 0; k < 3; ++k)
        if (!(center[k] + radius >= t->low[n][k] && center[k] - radius <= t->high[n][k])) return 0;
    return 1;
}

int NAME(const double **arg, double **res, long long int *iw, double *w, int mem) {
    (void)iw, (void)w, (void)mem;
    static const double none[9 * NF] = {0.0};
    const double *rotations = arg[0] ? arg[0] : none, *centers = arg[1] ? arg[1] : none;
    double number = arg[2] ? *arg[2] : 0.0, doubt = 0.0;
    static const Terrain nothing = {0};
    const Terrain *t = number >= 0.0 && number < MOST_TERRAINS ? terrains[(int)number] : 0;
    if (!t) t = &nothing, doubt = 1.0;
    for (int f = 0; f < NF; ++f) {
        const double *center = centers + 3 * f;
        int slot = 0;
        double x = floor((center[0] - t->origin[0]) / t->cell), y = floor((center[1] - t->origin[1]) / t->cell);
        if (x >= 0.0 && x < t->nx && y >= 0.0 && y < t->ny) {
            long long cell = (long long)x + t->nx * (long long)y;
            for (long long i = t->cell_first[cell]; i < t->cell_first[cell + 1]; ++i) {
                long long n = t->cell_shapes[i];
                Touch touch;
                if (!is_near(t, center, RADIUS[f], n)) continue;
                const double *material = t->materials[f * t->count + n];
                if (t->is_box[n] ? !touch_box(t, center, RADIUS[f], n, material[3], &touch)
                              : !touch_hull(t, rotations + 9 * f, center, f, n, material[3], &touch))
                    continue;
                if (slot == SLOTS) {
                    doubt = 1.0;
                    break;
                }
                int at = f * SLOTS + slot++;
                if (res[0]) res[0][at] = touch.distance;
                if (res[1]) memcpy(res[1] + 3 * at, touch.normal, sizeof touch.normal);
                if (res[2]) memcpy(res[2] + 3 * at, touch.offset, sizeof touch.offset);
                for (int k = 0; k < 3; ++k)
                    if (res[3 + k]) res[3 + k][at] = material[k];
            }
        }
        for (; slot < SLOTS; ++slot) {
            int at = f * SLOTS + slot;
            if (res[0]) res[0][at] = 1.0;
            for (int k = 0; k < 3; ++k) {
                if (res[1]) res[1][3 * at + k] = k == 2;
                if (res[2]) res[2][3 * at + k] = 0.0;
                if (res[3 + k]) res[3 + k][at] = 1.0;
            }
        }
    }
    if (res[6]) *res[6] = doubt;
    return 0;
}
