/* Spheres on many fixed shapes, such as the pieces of a terrain: the places where they touch. mpr.c goes before it.

A grid over the map tells which shapes may lie under a sphere. Contact with a box has a closed form, with a hull it is
Drake's iteration.

The text before both defines NAME; NF: the number of spheres; RADIUS[NF] (m); SPHERE_ID[NF]; SLOTS: the most contacts of a
sphere; N: the number of shapes; for each of them IS_BOX[N], HALF[N][3] (m, of a box), POSE[N][12]: its rotation by
columns and its position (m), CENTER[N][3] (m, in its frame), REACH[N]: the largest distance from the center (m), LOW[N][3]
and HIGH[N][3]: its box in the world (m), ID[N]; the vertices VERTICES[FIRST[n]] to VERTICES[FIRST[n + 1] - 1] (m, in
its frame); MATERIAL[NF][N] and MATERIALS[][4]: stiffness (N/m), dissipation, friction, and the share of the sphere in the
stiffness; the grid: ORIGIN_X, ORIGIN_Y, CELL (m), NX, NY, and the shapes CELL_SHAPES[CELL_FIRST[c]] to
CELL_SHAPES[CELL_FIRST[c + 1] - 1] of the cell c = ix + NX iy. Drake's id of a geometry tells which shape comes first.

Arguments: the rotations of the spheres in the world (3, 3 NF) by columns, and their centres (3, NF, m).
Results, SLOTS for each sphere: the distance (m, below 0 in contact, else above), the normal from the sphere into the shape
(3), the point of contact less the centre of the sphere (3, m), in the world, stiffness, dissipation and friction; and a
doubt: 1 where a sphere has more contacts, else 0. */

typedef struct {
    double distance, normal[3], offset[3];
} Touch;

/* The contact of a sphere with a box, by the nearest point of the box. */
static int touch_box(const double *center, double radius, int n, double share, Touch *touch) {
    double apart[3], p[3], out[3], length = 0.0, depth = INFINITY, distance, normal[3];
    int face = 0;
    subtract(center, POSE[n] + 9, apart);
    for (int k = 0; k < 3; ++k) {
        p[k] = dot(POSE[n] + 3 * k, apart);
        out[k] = p[k] - fmin(fmax(p[k], -HALF[n][k]), HALF[n][k]);
        length += out[k] * out[k];
        double below = HALF[n][k] - fabs(p[k]);
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
    for (int r = 0; r < 3; ++r) normal[r] = POSE[n][r] * out[0] + POSE[n][r + 3] * out[1] + POSE[n][r + 6] * out[2];
    touch->distance = distance;
    for (int k = 0; k < 3; ++k) {
        double on_sphere = -radius * normal[k], on_box = on_sphere - distance * normal[k];
        touch->normal[k] = -normal[k];
        touch->offset[k] = share * on_sphere + (1.0 - share) * on_box;
    }
    return 1;
}

/* The contact of a sphere with a hull, as Drake iterates. */
static int touch_hull(const double *R, const double *center, int f, int n, double share, Touch *touch) {
    static const double origin[3] = {0.0, 0.0, 0.0};
    double size[3] = {RADIUS[f], 0.0, 0.0}, normal[3], point[3];
    Shape sphere = {SPHERE, 1, size, &origin, origin, R, center};
    Shape hull = {HULL, FIRST[n + 1] - FIRST[n], size, VERTICES + FIRST[n], CENTER[n], POSE[n], POSE[n] + 9};
    int is_first = SPHERE_ID[f] < ID[n];
    Shape shapes[2] = {is_first ? sphere : hull, is_first ? hull : sphere};
    double middle[3], apart[3], reach = REACH[n] + 1.001 * RADIUS[f];
    into_world(&hull, CENTER[n], middle);
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

static int is_near(const double *center, double radius, int n) {
    for (int k = 0; k < 3; ++k)
        if (!(center[k] + radius >= LOW[n][k] && center[k] - radius <= HIGH[n][k])) return 0;
    return 1;
}

int NAME(const double **arg, double **res, long long int *iw, double *w, int mem) {
    (void)iw, (void)w, (void)mem;
    static const double none[9 * NF] = {0.0};
    const double *rotations = arg[0] ? arg[0] : none, *centers = arg[1] ? arg[1] : none;
    double doubt = 0.0;
    for (int f = 0; f < NF; ++f) {
        const double *center = centers + 3 * f;
        int slot = 0;
        double x = floor((center[0] - ORIGIN_X) / CELL), y = floor((center[1] - ORIGIN_Y) / CELL);
        if (x >= 0.0 && x < NX && y >= 0.0 && y < NY) {
            int cell = (int)x + NX * (int)y;
            for (int i = CELL_FIRST[cell]; i < CELL_FIRST[cell + 1]; ++i) {
                int n = CELL_SHAPES[i];
                Touch touch;
                if (!is_near(center, RADIUS[f], n)) continue;
                const double *material = MATERIALS[MATERIAL[f][n]];
                if (IS_BOX[n] ? !touch_box(center, RADIUS[f], n, material[3], &touch)
                              : !touch_hull(rotations + 9 * f, center, f, n, material[3], &touch))
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
