// Forward kinematics of general 6-6 Stewart platforms by Newton's method, one thread, SIMD across poses.
//
// Find t and R with |f_i| = l_i, f_i = t + R b_i - a_i, from one home pose. Residual (|f_i|^2 - l_i^2) / 2,
// Jacobian row [f_i, R b_i x f_i], update t += v and R = cayley(w) R: no trigonometry and no square root.
// A lane is a pose, and nothing branches: the number of steps is given, and so is the order of rows and
// columns in the elimination (from complete pivoting of the Jacobian at home, say: on symmetric platforms
// the natural order divides by zero there). Every pose starts at home, so the first step takes the inverse
// of the Jacobian there, which is given too.
//
//     g++ -std=c++17 -O3 -march=native -ffp-contract=fast -fno-math-errno -shared -fPIC newton_avx.cpp

#include <cmath>
#include <cstdint>

namespace {

#if defined(__AVX512F__)
constexpr int LANES = 8;
#elif defined(__AVX__)
constexpr int LANES = 4;
#else
constexpr int LANES = 2;
#endif
constexpr int VECTORS = 4;  // in flight together: each waits for its own pivots
constexpr int POSES = LANES * VECTORS;

typedef double V __attribute__((vector_size(8 * LANES)));

struct Vector {
    V t[3], q[4], r[9];       // quaternion (w, x, y, z), not of unit length; its rotation matrix by rows
    V square[6];              // of the lengths
    V upper[6][6], right[6];  // J x = 2 F after elimination, diagonal one
};

// The rotation matrix of the quaternion.
inline void rotate(Vector &s) {
    const V w = s.q[0], x = s.q[1], y = s.q[2], z = s.q[3];
    const V scale = 2.0 / (w * w + x * x + y * y + z * z);
    const V sx = scale * x, sy = scale * y, sz = scale * z;
    const V wx = w * sx, wy = w * sy, wz = w * sz, xx = x * sx, yy = y * sy, zz = z * sz;
    s.r[0] = 1.0 - yy - zz, s.r[1] = x * sy - wz, s.r[2] = x * sz + wy;
    s.r[3] = x * sy + wz, s.r[4] = 1.0 - xx - zz, s.r[5] = y * sz - wx;
    s.r[6] = x * sz - wy, s.r[7] = y * sz + wx, s.r[8] = 1.0 - xx - yy;
}

// Adds leg i to the elimination.
inline void eliminate(Vector &s, int i, const double *a, const double *b, const int *place) {
    V u[3], f[3], stored[6], row[6];
    for (int c = 0; c < 3; c++) {
        u[c] = s.t[c] - a[c];
        f[c] = u[c] + s.r[3 * c] * b[0] + s.r[3 * c + 1] * b[1] + s.r[3 * c + 2] * b[2];
        stored[place[c]] = f[c];
    }
    stored[place[3]] = f[1] * u[2] - f[2] * u[1];  // (f - u) x f = f x u
    stored[place[4]] = f[2] * u[0] - f[0] * u[2];
    stored[place[5]] = f[0] * u[1] - f[1] * u[0];
    V right = f[0] * f[0] + f[1] * f[1] + f[2] * f[2] - s.square[i];
#pragma GCC unroll 6
    for (int j = 0; j < 6; j++) row[j] = stored[j];
#pragma GCC unroll 6
    for (int k = 0; k < i; k++) {
#pragma GCC unroll 6
        for (int j = k + 1; j < 6; j++) row[j] -= row[k] * s.upper[k][j];
        right -= row[k] * s.right[k];
    }
    const V inverse = 1.0 / row[i];
#pragma GCC unroll 6
    for (int j = i + 1; j < 6; j++) s.upper[i][j] = row[j] * inverse;
    s.right[i] = right * inverse;
}

// Takes the step -x / 2, x in the order of the columns.
inline void move(Vector &s, const V *x, const int *place) {
    for (int c = 0; c < 3; c++) s.t[c] -= 0.5 * x[place[c]];
    const V h[3] = {-0.25 * x[place[3]], -0.25 * x[place[4]], -0.25 * x[place[5]]};  // half the turn
    const V q[4] = {s.q[0], s.q[1], s.q[2], s.q[3]};
    s.q[0] = q[0] - h[0] * q[1] - h[1] * q[2] - h[2] * q[3];  // (1, h) q
    s.q[1] = q[1] + h[0] * q[0] + h[1] * q[3] - h[2] * q[2];
    s.q[2] = q[2] + h[1] * q[0] + h[2] * q[1] - h[0] * q[3];
    s.q[3] = q[3] + h[2] * q[0] + h[0] * q[2] - h[1] * q[1];
    rotate(s);
}

inline void substitute_back(const Vector &s, V *x) {
#pragma GCC unroll 6
    for (int i = 5; i >= 0; i--) {
        x[i] = s.right[i];
#pragma GCC unroll 6
        for (int j = 5; j > i; j--) x[i] -= s.upper[i][j] * x[j];
    }
}

// The unit quaternion of a rotation matrix: the greatest of its four multiples.
void quaternion(const double *m, double *q) {
    const double all[4][4] = {{1 + m[0] + m[4] + m[8], m[7] - m[5], m[2] - m[6], m[3] - m[1]},
                              {m[7] - m[5], 1 + m[0] - m[4] - m[8], m[1] + m[3], m[2] + m[6]},
                              {m[2] - m[6], m[1] + m[3], 1 - m[0] + m[4] - m[8], m[5] + m[7]},
                              {m[3] - m[1], m[2] + m[6], m[5] + m[7], 1 - m[0] - m[4] + m[8]}};
    int best = 0;
    for (int k = 1; k < 4; k++)
        if (all[k][k] > all[best][best]) best = k;
    for (int k = 0; k < 4; k++) q[k] = all[best][k] / (2 * std::sqrt(all[best][best]));
}

// The largest | |f_i| - l_i | of a pose.
double length_error(const double *base, const double *platform, const double *l, const double *t,
                    const double *r) {
    double worst = 0;
    for (int i = 0; i < 6; i++) {
        double square = 0;
        for (int c = 0; c < 3; c++) {
            const double *b = platform + 3 * i, *along = r + 3 * c;
            const double f = t[c] - base[3 * i + c] + along[0] * b[0] + along[1] * b[1] + along[2] * b[2];
            square += f * f;
        }
        const double error = std::fabs(std::sqrt(square) - l[i]);
        if (!(error <= worst)) worst = error;
    }
    return worst;
}

}  // namespace

// base, platform (6, 3), lengths (count, 6), home_t (3), home_r (3, 3); rows, columns: permutations of 0..5;
// home_inverse (6, 6): the inverse of J(home)[rows][:, columns]; steps >= 1.
// -> translations (count, 3), rotations (count, 3, 3), errors (count), the largest in length, unless null
extern "C" void newton(int64_t count, const double *base, const double *platform, const double *lengths,
                       const double *home_t, const double *home_r, const int32_t *rows,
                       const int32_t *columns, const double *home_inverse, int32_t steps,
                       double *translations, double *rotations, double *errors) {
    double a[6][3], b[6][3], home_q[4], home_square[6];
    int place[6];
    quaternion(home_r, home_q);
    for (int i = 0; i < 6; i++) {
        place[columns[i]] = i;
        home_square[i] = 0;
        const double *p = platform + 3 * rows[i];
        for (int c = 0; c < 3; c++) {
            a[i][c] = base[3 * rows[i] + c], b[i][c] = p[c];
            const double *r = home_r + 3 * c;
            const double f = home_t[c] - a[i][c] + r[0] * p[0] + r[1] * p[1] + r[2] * p[2];
            home_square[i] += f * f;
        }
    }
    for (int64_t first = 0; first < count; first += POSES) {
        const int here = count - first < POSES ? int(count - first) : POSES;
        Vector s[VECTORS];
        V x[6];
        for (int k = 0; k < VECTORS; k++)  // after the last pose: the first of these again
            for (int i = 0; i < 6; i++) {
                V l;
#pragma GCC unroll 8
                for (int n = 0; n < LANES; n++) {
                    const int pose = LANES * k + n;
                    l[n] = lengths[6 * (first + (pose < here ? pose : 0)) + rows[i]];
                }
                s[k].square[i] = l * l;
            }
        for (int k = 0; k < VECTORS; k++) {
            for (int c = 0; c < 3; c++) s[k].t[c] = V{} + home_t[c];
            for (int c = 0; c < 4; c++) s[k].q[c] = V{} + home_q[c];
            for (int i = 0; i < 6; i++) {
                x[i] = V{};
                for (int j = 0; j < 6; j++)
                    x[i] += home_inverse[6 * i + j] * (home_square[j] - s[k].square[j]);
            }
            move(s[k], x, place);
        }
        for (int step = 1; step < steps; step++) {
#pragma GCC unroll 6
            for (int i = 0; i < 6; i++)
#pragma GCC unroll 4
                for (int k = 0; k < VECTORS; k++) eliminate(s[k], i, a[i], b[i], place);
#pragma GCC unroll 4
            for (int k = 0; k < VECTORS; k++) {
                substitute_back(s[k], x);
                move(s[k], x, place);
            }
        }
        for (int k = 0; k < VECTORS; k++)
            for (int n = 0; n < LANES; n++) {
                const int64_t pose = first + LANES * k + n;
                if (pose >= count) break;
                double *t = translations + 3 * pose, *r = rotations + 9 * pose;
                for (int c = 0; c < 3; c++) t[c] = s[k].t[c][n];
                for (int c = 0; c < 9; c++) r[c] = s[k].r[c][n];
                if (errors) errors[pose] = length_error(base, platform, lengths + 6 * pose, t, r);
            }
    }
}
