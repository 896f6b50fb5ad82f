/* The contact of two convex shapes as Drake's point contact computes it: by Minkowski portal refinement, which FCL takes
from libccd (Snethen, "XenoCollide: Complex collision made simple", Game Programming Gems 7, 2008; libccd's mpr.c, by
Daniel Fiser, BSD license).

A portal is a triangle of the surface of the Minkowski difference, shape 1 less shape 2, which the ray from its inner
point through the origin meets. Depth and normal are those of the point of the last portal that is nearest to the origin:
not of the nearest point of the whole surface. Signs, bounds and the order of tests are libccd's.

It is followed by mpr_pair.c for two shapes, or ground.c for spheres on many. */

#include <float.h>
#include <math.h>
#include <string.h>

enum { SPHERE, CAPSULE, CYLINDER, BOX, HULL };
#define MOST_ITERATIONS 500
#define TOLERANCE 2e-12 /* m, Drake's */

typedef struct {
    int kind, count;
    const double *size, (*vertices)[3], *center, *R, *p;
} Shape;

typedef struct {
    double v[3], first[3], second[3]; /* v = first - second, points of the shapes */
} Point;

static const double ORIGIN[3] = {0.0, 0.0, 0.0};

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void cross(const double *a, const double *b, double *c) {
    double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    c[0] = x, c[1] = y, c[2] = z;
}

static void subtract(const double *a, const double *b, double *c) {
    for (int k = 0; k < 3; ++k) c[k] = a[k] - b[k];
}

static void normalize(double *a) {
    double scale = 1.0 / sqrt(dot(a, a));
    for (int k = 0; k < 3; ++k) a[k] *= scale;
}

static int is_zero(double x) { return fabs(x) < DBL_EPSILON; }

static int is_equal(double a, double b) {
    double apart = fabs(a - b);
    return apart < DBL_EPSILON || apart < DBL_EPSILON * fmax(fabs(a), fabs(b));
}

static void into_world(const Shape *s, const double *local, double *world) {
    for (int r = 0; r < 3; ++r) world[r] = s->p[r] + s->R[r] * local[0] + s->R[r + 3] * local[1] + s->R[r + 6] * local[2];
}

/* The outermost vertex of a hull along d, in its frame. */
static const double *outermost_vertex(const Shape *s, const double *d) {
    const double *outermost = s->vertices[0];
    double height = dot(d, outermost);
    for (int i = 1; i < s->count; ++i) {
        double other = dot(d, s->vertices[i]);
        if (other > height) height = other, outermost = s->vertices[i];
    }
    return outermost;
}

/* The outermost point of a shape along sign * direction. */
static void support(const Shape *s, const double *direction, double sign, double *world) {
    double d[3], local[3] = {0.0, 0.0, 0.0};
    for (int c = 0; c < 3; ++c) d[c] = sign * dot(s->R + 3 * c, direction);
    if (s->kind == HULL) {
        into_world(s, outermost_vertex(s, d), world);
        return;
    }
    double length = sqrt(dot(d, d)), across = sqrt(d[0] * d[0] + d[1] * d[1]);
    if (s->kind == SPHERE || s->kind == CAPSULE) {
        for (int k = 0; k < 3; ++k) local[k] = s->size[0] * d[k] / length;
        if (s->kind == CAPSULE) local[2] += d[2] > 0.0 ? s->size[1] : -s->size[1];
    } else if (s->kind == CYLINDER) {
        for (int k = 0; k < 2; ++k) local[k] = is_zero(across) ? 0.0 : s->size[0] * d[k] / across;
        local[2] = is_zero(d[2]) ? 0.0 : d[2] > 0.0 ? s->size[1] : -s->size[1];
    } else {
        for (int k = 0; k < 3; ++k) local[k] = d[k] >= 0.0 ? s->size[k] : -s->size[k];
    }
    into_world(s, local, world);
}

static Point outermost(const Shape *shapes, const double *direction) {
    Point point;
    support(shapes, direction, 1.0, point.first);
    support(shapes + 1, direction, -1.0, point.second);
    subtract(point.first, point.second, point.v);
    return point;
}

static int is_positive(const double *a, const double *b) {
    double product = dot(a, b);
    return !is_zero(product) && product > 0.0;
}

/* The normal of the face through points 1, 2 and 3. */
static void face_normal(const Point *portal, double *normal) {
    double a[3], b[3];
    subtract(portal[2].v, portal[1].v, a);
    subtract(portal[3].v, portal[1].v, b);
    cross(a, b, normal);
    normalize(normal);
}

/* The normal of the face through points 0, 1 and 2. */
static void side_normal(const Point *portal, double *normal) {
    double a[3], b[3];
    subtract(portal[1].v, portal[0].v, a);
    subtract(portal[2].v, portal[0].v, b);
    cross(a, b, normal);
    normalize(normal);
}

/* Find a portal that the ray through the origin meets. Return 1; 2 if the ray goes through point 1; 0 without contact. */
static int discover(const Shape *shapes, Point *portal) {
    double direction[3], across[3];
    into_world(shapes, shapes[0].center, portal[0].first);
    into_world(shapes + 1, shapes[1].center, portal[0].second);
    subtract(portal[0].first, portal[0].second, portal[0].v);
    if (is_zero(portal[0].v[0]) && is_zero(portal[0].v[1]) && is_zero(portal[0].v[2])) portal[0].v[0] += 10.0 * DBL_EPSILON;
    subtract(ORIGIN, portal[0].v, direction);
    normalize(direction);
    portal[1] = outermost(shapes, direction);
    if (!is_positive(portal[1].v, direction)) return 0;
    cross(portal[0].v, portal[1].v, direction);
    if (is_zero(dot(direction, direction))) return 2;
    normalize(direction);
    portal[2] = outermost(shapes, direction);
    if (!is_positive(portal[2].v, direction)) return 0;
    side_normal(portal, direction);
    if (dot(direction, portal[0].v) > 0.0) {
        Point swapped = portal[1];
        portal[1] = portal[2], portal[2] = swapped;
        for (int k = 0; k < 3; ++k) direction[k] = -direction[k];
    }
    for (int k = 0; k < MOST_ITERATIONS; ++k) {
        portal[3] = outermost(shapes, direction);
        if (!is_positive(portal[3].v, direction)) return 0;
        int replaced = 0;
        cross(portal[1].v, portal[3].v, across);
        double side = dot(across, portal[0].v);
        if (side < 0.0 && !is_zero(side)) replaced = 2;
        if (!replaced) {
            cross(portal[3].v, portal[2].v, across);
            side = dot(across, portal[0].v);
            if (side < 0.0 && !is_zero(side)) replaced = 1;
        }
        if (!replaced) return 1;
        portal[replaced] = portal[3];
        side_normal(portal, direction);
    }
    return 0;
}

/* Whether a point is not farther out than the portal along its normal. */
static int reaches_tolerance(const Point *portal, const Point *point, const double *normal) {
    double least = INFINITY;
    for (int k = 1; k < 4; ++k) least = fmin(least, dot(point->v, normal) - dot(portal[k].v, normal));
    return is_equal(least, TOLERANCE) || least < TOLERANCE;
}

static void expand(Point *portal, const Point *point) {
    double side[3];
    cross(point->v, portal[0].v, side);
    if (dot(portal[1].v, side) > 0.0) portal[dot(portal[2].v, side) > 0.0 ? 1 : 3] = *point;
    else portal[dot(portal[3].v, side) > 0.0 ? 2 : 1] = *point;
}

/* Expand the portal until it encloses the origin; return whether it can. */
static int refine(const Shape *shapes, Point *portal) {
    double normal[3];
    for (int k = 0; k < MOST_ITERATIONS; ++k) {
        face_normal(portal, normal);
        double height = dot(normal, portal[1].v);
        if (is_zero(height) || height > 0.0) return 1;
        Point point = outermost(shapes, normal);
        height = dot(point.v, normal);
        if (!(is_zero(height) || height > 0.0) || reaches_tolerance(portal, &point, normal)) return 0;
        expand(portal, &point);
    }
    return 0;
}

/* The point of a segment that is nearest to the origin; return the square of its distance. */
static double nearest_of_segment(const double *a, const double *b, double *nearest) {
    double d[3];
    subtract(b, a, d);
    double t = -dot(a, d) / dot(d, d);
    if (t < 0.0 || is_zero(t)) memcpy(nearest, a, sizeof d);
    else if (t > 1.0 || is_equal(t, 1.0)) memcpy(nearest, b, sizeof d);
    else
        for (int k = 0; k < 3; ++k) nearest[k] = a[k] + t * d[k];
    return dot(nearest, nearest);
}

/* The point of the portal's triangle that is nearest to the origin. */
static void nearest_of_portal(const Point *portal, double *nearest) {
    const double *a = portal[1].v, *corners[4] = {portal[1].v, portal[2].v, portal[1].v, portal[3].v};
    double d1[3], d2[3], other[3], s = -1.0, t = -1.0;
    subtract(portal[2].v, a, d1);
    subtract(portal[3].v, a, d2);
    double v = dot(d1, d1), w = dot(d2, d2), p = dot(a, d1), q = dot(a, d2), r = dot(d1, d2), d = w * v - r * r;
    if (!is_zero(d / (w * v))) s = (q * r - w * p) / d, t = (-s * r - q) / w;
    if ((is_zero(s) || s > 0.0) && (is_equal(s, 1.0) || s < 1.0) && (is_zero(t) || t > 0.0) &&
        (is_equal(t, 1.0) || t < 1.0) && (is_equal(t + s, 1.0) || t + s < 1.0)) {
        for (int k = 0; k < 3; ++k) nearest[k] = a[k] + s * d1[k] + t * d2[k];
        return;
    }
    double least = nearest_of_segment(corners[0], corners[1], nearest);
    for (int side = 1; side < 3; ++side) {
        const double *from = side == 1 ? corners[2] : corners[1];
        double square = nearest_of_segment(from, corners[3], other);
        if (square < least) least = square, memcpy(nearest, other, sizeof other);
    }
}

/* The middle between the points of both shapes that belong to the origin in the tetrahedron of the portal. */
static void find_point(const Point *portal, double *point) {
    static const int order[4][4] = {{1, 2, 3, 0}, {3, 2, 0, 0}, {0, 1, 3, 0}, {2, 1, 0, 0}};
    double b[4], sum = 0.0, across[3], normal[3];
    for (int i = 0; i < 4; ++i) {
        cross(portal[order[i][0]].v, portal[order[i][1]].v, across);
        b[i] = dot(across, portal[order[i][2]].v);
        sum += b[i];
    }
    if (is_zero(sum) || sum < 0.0) {
        face_normal(portal, normal);
        b[0] = sum = 0.0;
        for (int i = 1; i < 4; ++i) {
            cross(portal[i % 3 + 1].v, portal[(i + 1) % 3 + 1].v, across);
            b[i] = dot(across, normal);
            sum += b[i];
        }
    }
    for (int k = 0; k < 3; ++k) {
        point[k] = 0.0;
        for (int i = 0; i < 4; ++i) point[k] += 0.5 * b[i] * (portal[i].first[k] + portal[i].second[k]) / sum;
    }
}

/* Return the depth of the contact and fill in normal and point; below 0 without contact. */
static double penetration(const Shape *shapes, double *normal, double *point) {
    Point portal[4];
    int discovered = discover(shapes, portal);
    if (!discovered) return -1.0;
    if (discovered == 2) {
        memcpy(normal, portal[1].v, 3 * sizeof *normal);
        for (int k = 0; k < 3; ++k) point[k] = 0.5 * (portal[1].first[k] + portal[1].second[k]);
    } else {
        if (!refine(shapes, portal)) return -1.0;
        for (int k = 0; k <= MOST_ITERATIONS + 1; ++k) {
            face_normal(portal, normal);
            Point further = outermost(shapes, normal);
            if (reaches_tolerance(portal, &further, normal) || k > MOST_ITERATIONS) break;
            expand(portal, &further);
        }
        nearest_of_portal(portal, normal);
        find_point(portal, point);
    }
    double depth = sqrt(dot(normal, normal));
    if (depth <= DBL_EPSILON) return -1.0; /* Drake takes it for no contact */
    normalize(normal);
    return depth;
}
