// Plan how one quadrotor catches one ball: the published problem of the catch planner, by L-BFGS.
//
//     catch FILE [name=value ...]
//
// FILE is a table such as tests/data/catch_paper.csv. A plan is a minimum-snap spline of four
// equally long pieces from rest at (0, 0, 1). Its variables are the three inner waypoints, the
// logarithm of the duration T, and position, velocity and acceleration at T; the jerk at T is zero.
// The cost is the integral of |snap|^2, 1000 T, and penalties of speed, body rate, thrust and
// height at 16 intervals a piece, of the net's distance from the ball and of its angle.
//
// With relative=1 the optima are the same, but the variables are offsets of the waypoints from the
// smoothest trajectory to the end ("tail"), in coordinates in which the energy is the squared norm
// of the offsets, and the net's position relative to the ball. With memory=0 the search is BFGS
// with a dense matrix, which is small for 19 variables.
//
// The program plans all cases of the file, one after another, in several rounds. It prints the CPU
// time of the fastest round (without reading and printing), then a line for each case.
//
// Four choices make the program fast. First, if time is measured in units of the duration h of a
// piece, the spline is a constant linear map of six rows: the waypoints and (p, v h, a h^2) at T,
// relative to the start ("head"), whose derivatives are zero. Second, samples are processed in
// vectors. Third, simple bounds without a root or a division exclude most vectors, in which no
// limit is exceeded and the gradient is zero. Fourth, planning allocates no memory.

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <fstream>
#include <limits>
#include <map>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace {

#ifdef __AVX512F__
constexpr int kWidth = 8;
#else
constexpr int kWidth = 4;
#endif
typedef double Vec __attribute__((vector_size(8 * kWidth)));

constexpr int kPieces = 4;
constexpr int kNodes = 16;                      // intervals of a piece between two samples
constexpr int kDegree = 7;                      // degree of a minimum-snap polynomial
constexpr int kSamples = kPieces * kNodes;      // without the start, where limits always hold
constexpr int kBlocks = kSamples / kWidth;
constexpr int kInner = kPieces - 1;             // number of waypoints
constexpr int kColumns = kInner + 3;            // waypoints, then p, v, a at the end
constexpr int kVariables = 19;
constexpr int kRegisters = (kVariables + kWidth - 1) / kWidth;
constexpr int kPadded = kRegisters * kWidth;
constexpr int kMostMemory = 64;
constexpr int kMostPast = 64;

constexpr double kGravity = 9.81;
constexpr double kDrag = 0.5;
constexpr double kTimeWeight = 1000.0;
constexpr double kLimitWeight = 1e5;
constexpr double kGroundWeight = 1e7;
constexpr double kMissWeight = 1e4;
constexpr double kAngleWeight = 1e2;
constexpr double kWidthOfHinge = 0.01;          // mu of the hinge, and eps of the angle
constexpr double kMostSpeed = 5.0;
constexpr double kMostRate = 5.0;
constexpr double kMiddleThrust = 1.4 * kGravity;
constexpr double kHalfThrust = 1.1 * kGravity;
constexpr double kLeastThrust = kMiddleThrust - kHalfThrust;
constexpr double kMostThrust = kMiddleThrust + kHalfThrust;
constexpr double kLeastHeight = 0.25;
constexpr double kNetHeight = 0.2;
constexpr double kNetRadius = 0.125;
const double kSafeCosine = std::cos(std::acos(-1.0) / 6.0);
constexpr double kHead[3] = {0.0, 0.0, 1.0};

// Index of the first number of log T, position, velocity and acceleration in the vector of
// variables. The waypoints come first, ordered by axis.
constexpr int kLogTime = 9, kPosition = 10, kVelocity = 13, kAcceleration = 16;

struct alignas(64) Point {
    union {
        Vec reg[kRegisters];
        double at[kPadded];
    };
};

inline Vec spread(double value) { return value - Vec{}; }

inline Vec larger(Vec a, Vec b) { return a > b ? a : b; }

inline Vec smaller(Vec a, Vec b) { return a < b ? a : b; }

inline double total(Vec a) {
    double sum = 0.0;
    for (int i = 0; i < kWidth; ++i) sum += a[i];
    return sum;
}

inline double greatest(Vec a) {
    double most = a[0];
    for (int i = 1; i < kWidth; ++i) most = a[i] > most ? a[i] : most;
    return most;
}

inline Vec root(Vec a) {
    Vec result = a;
    for (int i = 0; i < kWidth; ++i) result[i] = std::sqrt(a[i]);
    return result;
}

inline double dot(const Point& a, const Point& b) {
    Vec sum = a.reg[0] * b.reg[0];
    for (int i = 1; i < kRegisters; ++i) sum += a.reg[i] * b.reg[i];
    return total(sum);
}

inline void add(Point& to, double factor, const Point& what) {
    for (int i = 0; i < kRegisters; ++i) to.reg[i] += factor * what.reg[i];
}

// Return k (k - 1) ... (k - order + 1), the factor of t^k in the derivative of the given order.
double falling(int k, int order) {
    double factor = 1.0;
    for (int i = 0; i < order; ++i) factor *= k - i;
    return factor;
}

// Constant matrices of the spline, with time in units of the duration of a piece. The "columns" are
// the waypoints (or offsets) and the state at the end, from which the matrices compute the spline.
struct Spline {
    const bool relative;  // whether the first columns are offsets instead of waypoints
    double coefficients[kPieces][kDegree + 1][kColumns];
    alignas(64) Vec samples[kBlocks][4][kColumns];  // by order of the derivative
    double energy[kColumns][kColumns];  // triangular: the energy is |energy . columns|^2
    double offsets[kInner][kColumns];   // from waypoints and tail; the energy is the squared norm
    Vec weights[kBlocks];  // of the trapezoid rule, relative to a piece's duration

    explicit Spline(bool relative) : relative(relative) {
        solve();
        factorise();
        if (relative) change_columns();
        for (int k = 0; k < kSamples; ++k) {
            const double time = double(k + 1) / kNodes;
            for (int order = 0; order < 4; ++order) {
                const auto found = row(time, order);
                for (int c = 0; c < kColumns; ++c)
                    samples[k / kWidth][order][c][k % kWidth] = found[c];
            }
            weights[k / kWidth][k % kWidth] = (k + 1 == kSamples ? 0.5 : 1.0) / kNodes;
        }
    }

    // Return the coefficients with which a derivative at a time from 0 to 4 is a sum of the
    // columns.
    std::array<double, kColumns> row(double time, int order) const {
        const int piece = std::min(int(time), kPieces - 1);
        const double inside = time - piece;
        std::array<double, kColumns> found{};
        for (int k = order; k <= kDegree; ++k) {
            const double basis = falling(k, order) * std::pow(inside, k - order);
            for (int c = 0; c < kColumns; ++c) found[c] += basis * coefficients[piece][k][c];
        }
        return found;
    }

  private:
    // Solve for the polynomial coefficients as linear functions of the columns. The equations are
    // the standstill at the start, the state at the end, the positions of the waypoints, and six
    // continuous derivatives at each waypoint.
    void solve() {
        constexpr int size = kPieces * (kDegree + 1);
        std::vector<std::array<double, size + kColumns>> rows;
        const auto blank = [&rows]() -> std::array<double, size + kColumns>& {
            rows.push_back({});
            return rows.back();
        };
        const auto put = [](auto& to, int piece, double time, int order, double sign) {
            for (int k = order; k <= kDegree; ++k)
                to[piece * (kDegree + 1) + k] +=
                    sign * falling(k, order) * std::pow(time, k - order);
        };
        for (int order = 0; order < 4; ++order) {
            put(blank(), 0, 0.0, order, 1.0);
            auto& last = blank();
            put(last, kPieces - 1, 1.0, order, 1.0);
            if (order < 3) last[size + kInner + order] = 1.0;
        }
        for (int joint = 1; joint < kPieces; ++joint) {
            auto& through = blank();
            put(through, joint, 0.0, 0, 1.0);
            through[size + joint - 1] = 1.0;
            for (int order = 0; order < kDegree; ++order) {
                auto& smooth = blank();
                put(smooth, joint - 1, 1.0, order, 1.0);
                put(smooth, joint, 0.0, order, -1.0);
            }
        }
        for (int i = 0; i < size; ++i) {  // Gauss-Jordan elimination with partial pivoting
            const auto by_size = [i](const auto& a, const auto& b) {
                return std::abs(a[i]) < std::abs(b[i]);
            };
            std::swap(rows[i], *std::max_element(rows.begin() + i, rows.end(), by_size));
            for (int j = 0; j < size; ++j) {
                const double factor = j == i ? 0.0 : rows[j][i] / rows[i][i];
                if (factor == 0.0) continue;
                for (int k = i; k < size + kColumns; ++k) rows[j][k] -= factor * rows[i][k];
            }
        }
        for (int i = 0; i < size; ++i)
            for (int c = 0; c < kColumns; ++c)
                coefficients[i / (kDegree + 1)][i % (kDegree + 1)][c] =
                    rows[i][size + c] / rows[i][i];
    }

    // Compute a triangular square root of the matrix of the snap energy, by Gram-Schmidt on the
    // snap at four Gauss points a piece. With the matrix itself, small energies would be lost to
    // rounding.
    void factorise() {
        const double points[2] = {0.3399810435848563, 0.8611363115940526};
        const double shares[2] = {0.6521451548625461, 0.3478548451374538};
        std::vector<std::array<double, kColumns>> snap;
        for (int piece = 0; piece < kPieces; ++piece)
            for (int i = 0; i < 4; ++i) {
                const double inside = 0.5 + 0.5 * (i % 2 ? 1.0 : -1.0) * points[i / 2];
                snap.push_back(row(piece + inside, 4));
                for (double& each : snap.back()) each *= std::sqrt(0.5 * shares[i / 2]);
            }
        for (int i = 0; i < kColumns; ++i) {
            double size = 0.0;
            for (const auto& each : snap) size += each[i] * each[i];
            size = std::sqrt(size);
            energy[i][i] = size;
            for (int j = 0; j < i; ++j) energy[i][j] = 0.0;
            for (int j = i + 1; j < kColumns; ++j) {
                double along = 0.0;
                for (const auto& each : snap) along += each[i] * each[j] / size;
                energy[i][j] = along;
                for (auto& each : snap) each[j] -= along * each[i] / size;
            }
        }
        for (int i = 0; i < kInner; ++i)
            std::copy_n(energy[i], kColumns, offsets[i]);
    }

    // Change the matrices such that the first columns are offsets instead of waypoints. The first
    // rows of the energy's square root convert waypoints to offsets.
    void change_columns() {
        double waypoints[kInner][kColumns];
        for (int c = 0; c < kColumns; ++c)
            for (int i = kInner - 1; i >= 0; --i) {
                double rest = c < kInner ? double(c == i) : -offsets[i][c];
                for (int k = i + 1; k < kInner; ++k) rest -= offsets[i][k] * waypoints[k][c];
                waypoints[i][c] = rest / offsets[i][i];
            }
        for (auto& piece : coefficients)
            for (auto& form : piece) {
                double changed[kColumns] = {};
                for (int c = 0; c < kColumns; ++c) {
                    if (c >= kInner) changed[c] = form[c];
                    for (int i = 0; i < kInner; ++i) changed[c] += form[i] * waypoints[i][c];
                }
                std::copy_n(changed, kColumns, form);
            }
        for (int i = 0; i < kInner; ++i)
            for (int c = 0; c < kColumns; ++c) energy[i][c] = double(c == i);
    }
};

struct Ball {
    double pos[3], vel[3];
};

struct Case {
    Ball ball;
    double guessed_time;
};

// Compute position, velocity and acceleration of a ball with linear drag after a time.
inline void fly(const Ball& ball, double time, double pos[3], double vel[3], double acc[3]) {
    const double rest = std::exp(-kDrag * time);
    for (int i = 0; i < 3; ++i) {
        const double end = i == 2 ? -kGravity / kDrag : 0.0;
        pos[i] = ball.pos[i] + (ball.vel[i] - end) * (1.0 - rest) / kDrag + end * time;
        vel[i] = end + (ball.vel[i] - end) * rest;
        acc[i] = kDrag * (end - vel[i]);
    }
}

struct Hinge {
    Vec value, slope;
};

// The penalty of an excess x along the trajectory, and its derivative: zero for x < 0, a quartic
// polynomial up to the width, and linear above.
inline Hinge smoothed(Vec x, double width) {
    const Vec inside = smaller(larger(x, Vec{}), spread(width));
    const Vec share = inside * (1.0 / width);
    const Vec square = share * share;
    return {(width - 0.5 * inside) * square * share + larger(x - width, Vec{}),
            square * (3.0 - 2.0 * share)};
}

// The penalty of an excess x at the catch, and its derivative `slope`: zero for x < 0, cubic up to
// the width, and a far steeper cubic above.
inline double steep(double x, double width, double& slope) {
    slope = 0.0;
    if (x <= 0.0) return 0.0;
    if (x <= width) {
        slope = 3.0 * x * x;
        return x * x * x;
    }
    const double beyond = x - width, unit = 1.0 / (width * width * width * width);
    slope = beyond * (2.0 * x + beyond) * unit;
    return width * width * width + beyond * beyond * x * unit;
}

// The states of ball, quadrotor and net at the end of a plan, when the ball is caught.
struct Catch {
    double ball_pos[3], ball_vel[3], ball_acc[3];
    double axis[3], inverse_thrust;  // of the quadrotor
    double miss[3];                  // vector from the ball to the net
    double tail[3];                  // position of the quadrotor relative to the head
};

inline Catch catch_at(const Spline& spline, const Case& task, const Point& x, double duration) {
    Catch found;
    fly(task.ball, duration, found.ball_pos, found.ball_vel, found.ball_acc);
    const double* acc = &x.at[kAcceleration];
    const double tau[3] = {acc[0], acc[1], acc[2] + kGravity};
    const double thrust2 = tau[0] * tau[0] + tau[1] * tau[1] + tau[2] * tau[2];
    found.inverse_thrust = 1.0 / std::sqrt(std::max(thrust2, 1e-12));
    for (int i = 0; i < 3; ++i) {
        found.axis[i] = tau[i] * found.inverse_thrust;
        const double at = x.at[kPosition + i];
        const double below = found.ball_pos[i] - kNetHeight * found.axis[i];
        found.miss[i] = spline.relative ? at : at - below;
        found.tail[i] = (spline.relative ? at + below : at) - kHead[i];
    }
    return found;
}

// Compute the columns, from which the spline is a linear map, from the variables and the end.
inline void fill_columns(const Spline& spline, const Point& x, const double tail[3], double h,
                         double columns[kColumns][3]) {
    for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < kInner; ++k)
            columns[k][i] = x.at[3 * k + i] - (spline.relative ? 0.0 : kHead[i]);
        columns[kInner][i] = tail[i];
        columns[kInner + 1][i] = x.at[kVelocity + i] * h;
        columns[kInner + 2][i] = x.at[kAcceleration + i] * h * h;
    }
}

// Return the cost at the variables x, and compute its gradient `slope`.
double cost_of(const Spline& spline, const Case& task, const Point& x, Point& slope) {
    const double duration = std::exp(x.at[kLogTime]), h = duration / kPieces;
    const double rate = 1.0 / h;
    const Catch at_end = catch_at(spline, task, x, duration);
    double columns[kColumns][3], by_columns[kColumns][3];
    fill_columns(spline, x, at_end.tail, h, columns);
    double by_h = 0.0, by_time = kTimeWeight, cost = kTimeWeight * duration;

    // Add the penalties of the limits along the trajectory.
    const double rates[4] = {1.0, rate, rate * rate, rate * rate * rate};
    Vec sums[kColumns][3] = {};
    Vec penalty{}, with_h{};
    bool any = false;
    for (int block = 0; block < kBlocks; ++block) {
        const auto& matrix = spline.samples[block];
        Vec z{}, motion[3][3] = {};
        for (int c = 0; c < kColumns; ++c) z += matrix[0][c] * columns[c][2];
        for (int order = 0; order < 3; ++order) {
            for (int c = 0; c < kColumns; ++c)
                for (int i = 0; i < 3; ++i)
                    motion[order][i] += matrix[order + 1][c] * columns[c][i];
            for (int i = 0; i < 3; ++i) motion[order][i] *= rates[order + 1];
        }
        const Vec *v = motion[0], *a = motion[1], *j = motion[2];
        const Vec tx = a[0], ty = a[1], tz = a[2] + kGravity;
        const Vec jerk2 = j[0] * j[0] + j[1] * j[1] + j[2] * j[2];
        const Vec thrust2 = tx * tx + ty * ty + tz * tz;
        const Vec fast = v[0] * v[0] + v[1] * v[1] + v[2] * v[2] - kMostSpeed * kMostSpeed;
        const Vec low = (kLeastHeight - kHead[2]) - z;
        // These bounds need neither a root nor a division. While the thrust points up, the squared
        // body rate is at most twice the squared ratio of jerk and thrust.
        const Vec inside = larger(larger(thrust2 - kMostThrust * kMostThrust,
                                         kLeastThrust * kLeastThrust - thrust2),
                                  larger(2.0 * jerk2 - kMostRate * kMostRate * thrust2, -tz));
        if (greatest(larger(larger(fast, low), inside)) <= 0.0) continue;

        const Vec squared = larger(thrust2, spread(1e-4));
        const Vec thrust = root(squared);
        const Vec inverse = 1.0 / thrust;
        const Vec inverse2 = inverse * inverse;
        const Vec along = (tx * j[0] + ty * j[1] + tz * j[2]) * inverse2;
        const Vec tilt = (jerk2 - along * along * squared) * inverse2;
        const Vec upright = larger(thrust + tz, spread(1e-2));
        const Vec inverse_twist = 1.0 / (thrust * upright);
        const Vec twist = (ty * j[0] - tx * j[1]) * inverse_twist;
        const Vec middle = thrust - kMiddleThrust;
        const Vec turning = tilt + twist * twist - kMostRate * kMostRate;
        const Vec pushing = middle * middle - kHalfThrust * kHalfThrust;
        if (greatest(larger(larger(fast, turning), larger(pushing, low))) <= 0.0) continue;

        any = true;
        const Hinge speed = smoothed(fast, kWidthOfHinge), turn = smoothed(turning, kWidthOfHinge);
        const Hinge push = smoothed(pushing, kWidthOfHinge), ground = smoothed(low, kWidthOfHinge);
        const Vec weight = spline.weights[block];
        penalty += weight * (kLimitWeight * (speed.value + turn.value + push.value) +
                             kGroundWeight * ground.value);
        // The following are derivatives of the penalties by height, velocity, acceleration and
        // jerk, times the sample's weight and h.
        const Vec share = weight * (2.0 * kLimitWeight * h);
        const Vec by_speed = share * speed.slope, by_turn = share * turn.slope;
        const Vec by_push = share * push.slope * middle * inverse;
        const Vec by_low = weight * (-kGroundWeight * h) * ground.slope;
        const Vec by_twist = by_turn * twist * inverse_twist;
        const Vec turned = by_turn * inverse2;
        // The denominator of `twist`, the part of the body rate about the z axis, is
        // |tau|^2 + |tau| tau_z, with the thrust tau.
        const Vec by_denominator = by_twist * twist;
        const Vec by_tau = by_push + turned * (along * along - tilt) -
                           by_denominator * (2.0 + tz * inverse);
        const Vec by_jerk_in_tau = turned * along;
        Vec by_vel[3], by_acc[3], by_jerk[3];
        const Vec tau[3] = {tx, ty, tz};
        for (int i = 0; i < 3; ++i) {
            by_vel[i] = by_speed * v[i];
            by_acc[i] = by_tau * tau[i] - by_jerk_in_tau * j[i];
            by_jerk[i] = turned * j[i] - by_jerk_in_tau * tau[i];
        }
        by_acc[0] -= by_twist * j[1];
        by_acc[1] += by_twist * j[0];
        by_acc[2] -= by_denominator * thrust;
        by_jerk[0] += by_twist * ty;
        by_jerk[1] -= by_twist * tx;
        for (int i = 0; i < 3; ++i) {
            with_h += by_vel[i] * v[i] + 2.0 * by_acc[i] * a[i] + 3.0 * by_jerk[i] * j[i];
            by_vel[i] *= rates[1];
            by_acc[i] *= rates[2];
            by_jerk[i] *= rates[3];
        }
        for (int c = 0; c < kColumns; ++c) {
            for (int i = 0; i < 3; ++i)
                sums[c][i] += matrix[1][c] * by_vel[i] + matrix[2][c] * by_acc[i] +
                              matrix[3][c] * by_jerk[i];
            sums[c][2] += matrix[0][c] * by_low;
        }
    }
    for (int c = 0; c < kColumns; ++c)
        for (int i = 0; i < 3; ++i) by_columns[c][i] = any ? total(sums[c][i]) : 0.0;
    if (any) {
        const double spent = total(penalty);
        cost += h * spent;
        by_h += spent - rate * total(with_h);
    }

    // Add the snap energy.
    const double unit = rates[3] * rates[3] * rate;
    double energy = 0.0;
    for (int i = 0; i < 3; ++i) {
        double sizes[kColumns];
        for (int r = 0; r < kColumns; ++r) {
            sizes[r] = 0.0;
            for (int c = r; c < kColumns; ++c) sizes[r] += spline.energy[r][c] * columns[c][i];
            energy += sizes[r] * sizes[r];
            sizes[r] *= 2.0 * unit;
        }
        for (int c = 0; c < kColumns; ++c)
            for (int r = 0; r <= c; ++r) by_columns[c][i] += spline.energy[r][c] * sizes[r];
    }
    cost += unit * energy;
    by_h -= kDegree * unit * energy * rate;

    // Add the penalties of the net's distance from the ball and of its angle.
    double distance2 = 0.0, speed2 = 0.0, facing = 0.0;
    for (int i = 0; i < 3; ++i) {
        distance2 += at_end.miss[i] * at_end.miss[i];
        speed2 += at_end.ball_vel[i] * at_end.ball_vel[i];
        facing += at_end.axis[i] * at_end.ball_vel[i];
    }
    const double distance = std::sqrt(distance2), inverse_speed = 1.0 / std::sqrt(speed2);
    double by_distance, by_angle;
    cost += kMissWeight * steep(distance, kNetRadius, by_distance);
    facing *= inverse_speed;
    cost += kAngleWeight * steep(kSafeCosine + facing, kWidthOfHinge, by_angle);
    by_distance *= distance > 0.0 ? kMissWeight / distance : 0.0;
    by_angle *= kAngleWeight * inverse_speed;
    double by_pos[3], by_axis[3], leaning = 0.0, turning = 0.0;
    for (int i = 0; i < 3; ++i) {
        const double by_tail = by_columns[kInner][i], by_miss = by_distance * at_end.miss[i];
        by_pos[i] = by_tail + by_miss;
        // This is the derivative by the position of the quadrotor for which the net's centre is at
        // the ball.
        const double by_below = spline.relative ? by_tail : -by_miss;
        by_axis[i] = by_angle * at_end.ball_vel[i] - kNetHeight * by_below;
        leaning += by_axis[i] * at_end.axis[i];
        turning += at_end.ball_acc[i] *
                   (at_end.axis[i] - facing * inverse_speed * at_end.ball_vel[i]);
        by_time += by_below * at_end.ball_vel[i];
    }
    by_time += by_angle * turning;

    for (int i = 0; i < 3; ++i) {
        const double by_vel = by_columns[kInner + 1][i], by_acc = by_columns[kInner + 2][i];
        by_h += by_vel * x.at[kVelocity + i] + 2.0 * h * by_acc * x.at[kAcceleration + i];
        for (int k = 0; k < kInner; ++k) slope.at[3 * k + i] = by_columns[k][i];
        slope.at[kPosition + i] = by_pos[i];
        slope.at[kVelocity + i] = by_vel * h;
        slope.at[kAcceleration + i] =
            by_acc * h * h + (by_axis[i] - leaning * at_end.axis[i]) * at_end.inverse_thrust;
    }
    slope.at[kLogTime] = duration * (by_time + by_h / kPieces);
    for (int i = kVariables; i < kPadded; ++i) slope.at[i] = 0.0;
    return cost;
}

// Return the initial guess: from standstill to standstill below the ball at the guessed time, with
// waypoints on the minimum-jerk trajectory.
Point guess_of(const Spline& spline, const Case& task) {
    Point x{};
    double ball[3], vel[3], acc[3];
    fly(task.ball, task.guessed_time, ball, vel, acc);
    x.at[kLogTime] = std::log(task.guessed_time);
    for (int i = 0; i < 3; ++i) {
        const double tail = ball[i] - (i == 2 ? kNetHeight : 0.0);
        double way[kColumns] = {};
        for (int k = 0; k < kInner; ++k) {
            const double s = double(k + 1) / kPieces;
            way[k] = s * s * s * (10.0 - 15.0 * s + 6.0 * s * s) * (tail - kHead[i]);
        }
        way[kInner] = tail - kHead[i];
        for (int k = 0; k < kInner; ++k) {
            double offset = 0.0;
            for (int c = 0; c < kColumns; ++c) offset += spline.offsets[k][c] * way[c];
            x.at[3 * k + i] = spline.relative ? offset : kHead[i] + way[k];
        }
        x.at[kPosition + i] = spline.relative ? 0.0 : tail;
    }
    return x;
}

struct Settings {
    int memory = 48;          // number of pairs that L-BFGS stores; 0 for BFGS
    int past = 10;            // iterations over which the cost is compared
    double delta = 1e-7;      // relative change of the cost that ends the search
    int most_steps = 1000;
    double decrease = 1e-4, curvature = 0.9;  // constants of the weak Wolfe conditions
    int relative = 0;         // 1: variables relative to the smoothest trajectory and to the ball
    int interpolate = 0;      // 1: cubic interpolation within a bracket, 0: bisection
    double scale_q = 1.0, scale_t = 1.0, scale_p = 1.0, scale_v = 1.0, scale_a = 1.0;
    int repeats = 3;
};

struct Result {
    Point x;
    double cost;
    int iterations, evaluations;
};

// The search of one plan by L-BFGS or BFGS. One object plans all cases, so that planning allocates
// no memory.
class Search {
  public:
    Search(const Spline& spline, const Settings& settings) : spline_(spline), given_(settings) {
        scale_ = Point{};
        for (int i = 0; i < kVariables; ++i)
            scale_.at[i] = i < kLogTime ? given_.scale_q
                           : i == kLogTime ? given_.scale_t
                           : i < kVelocity ? given_.scale_p
                           : i < kAcceleration ? given_.scale_v : given_.scale_a;
    }

    Result plan(const Case& task) {
        Point x = guess_of(spline_, task), g, x_new, g_new, direction;
        for (int i = 0; i < kVariables; ++i) x.at[i] /= scale_.at[i];
        evaluations_ = 0;
        double cost = evaluate(task, x, g);
        first_ = count_ = 0;
        for (int i = 0; i < kRegisters; ++i) direction.reg[i] = -g.reg[i];
        double step = 1.0 / std::sqrt(dot(g, g));
        costs_[0] = cost;
        int k = 1;
        for (; k <= given_.most_steps; ++k) {
            const double cost_before = cost;
            if (!search(task, x, cost, g, direction, step, x_new, g_new)) break;
            Point s, y;
            for (int i = 0; i < kRegisters; ++i) {
                s.reg[i] = x_new.reg[i] - x.reg[i];
                y.reg[i] = g_new.reg[i] - g.reg[i];
            }
            if (cost > cost_before) break;
            const double size = std::sqrt(dot(g, g));
            x = x_new;
            if (k >= given_.past) {
                const double before = costs_[k % given_.past];
                if (std::abs(before - cost) < given_.delta * std::max(1.0, std::abs(cost))) {
                    g = g_new;
                    break;
                }
            }
            costs_[k % given_.past] = cost;
            const double ys = dot(y, s);
            const bool curved = ys > 1e-6 * size * dot(s, s);
            if (given_.memory)
                limited(s, y, ys, curved, g_new, direction);
            else
                dense(s, y, ys, curved, k == 1, g, g_new, direction);
            g = g_new;
            step = 1.0;
        }
        for (int i = 0; i < kRegisters; ++i) x.reg[i] *= scale_.reg[i];
        return {x, cost, k, evaluations_};
    }

    double guess_cost(const Case& task) const {
        Point slope;
        return cost_of(spline_, task, guess_of(spline_, task), slope);
    }

  private:
    double evaluate(const Case& task, const Point& x, Point& g) {
        Point natural;
        for (int i = 0; i < kRegisters; ++i) natural.reg[i] = x.reg[i] * scale_.reg[i];
        const double cost = cost_of(spline_, task, natural, g);
        for (int i = 0; i < kRegisters; ++i) g.reg[i] *= scale_.reg[i];
        ++evaluations_;
        return cost;
    }

    // Search along a direction for a step with the weak Wolfe conditions, by the method of Lewis
    // and Overton. Sets the new point, its cost and its gradient.
    bool search(const Case& task, const Point& x, double& cost, const Point& g,
                const Point& direction, double step, Point& x_new, Point& g_new) {
        const double slope = dot(g, direction), begun = cost;
        if (!(slope < 0.0)) return false;
        double low = 0.0, high = std::numeric_limits<double>::infinity();
        double cost_low = begun, slope_low = slope, cost_high = 0.0, slope_high = 0.0;
        for (int trial = 0; trial < 40; ++trial) {
            for (int i = 0; i < kRegisters; ++i)
                x_new.reg[i] = x.reg[i] + step * direction.reg[i];
            cost = evaluate(task, x_new, g_new);
            const double along = dot(g_new, direction);
            if (!(cost <= begun + given_.decrease * step * slope)) {
                high = step, cost_high = cost, slope_high = along;
            } else if (along < given_.curvature * slope) {
                low = step, cost_low = cost, slope_low = along;
            } else {
                return true;
            }
            if (high == std::numeric_limits<double>::infinity()) {
                step *= 2.0;
                continue;
            }
            const double width = high - low;
            step = low + 0.5 * width;
            if (given_.interpolate) {
                const double d1 = slope_low + slope_high - 3.0 * (cost_high - cost_low) / width;
                const double inside = d1 * d1 - slope_low * slope_high;
                if (inside > 0.0) {
                    const double d2 = std::sqrt(inside);
                    const double share =
                        1.0 - (slope_high + d2 - d1) / (slope_high - slope_low + 2.0 * d2);
                    if (share > 0.0 && share < 1.0)
                        step = low + std::min(std::max(share, 0.1), 0.9) * width;
                }
            }
        }
        return cost < begun;
    }

    // Compute the search direction of L-BFGS, by the two-loop recursion over the stored pairs.
    void limited(const Point& s, const Point& y, double ys, bool curved, const Point& g,
                 Point& direction) {
        if (curved) {
            steps_[first_] = s;
            changes_[first_] = y;
            inverse_[first_] = 1.0 / ys;
            first_ = first_ + 1 == given_.memory ? 0 : first_ + 1;
            count_ = std::min(count_ + 1, given_.memory);
            unit_ = ys / dot(y, y);
        }
        for (int i = 0; i < kRegisters; ++i) direction.reg[i] = -g.reg[i];
        if (!count_) return;
        int j = first_;
        for (int i = 0; i < count_; ++i) {
            j = j == 0 ? given_.memory - 1 : j - 1;
            shares_[j] = dot(steps_[j], direction) * inverse_[j];
            add(direction, -shares_[j], changes_[j]);
        }
        for (int i = 0; i < kRegisters; ++i) direction.reg[i] *= unit_;
        for (int i = 0; i < count_; ++i) {
            add(direction, shares_[j] - dot(changes_[j], direction) * inverse_[j], steps_[j]);
            j = j + 1 == given_.memory ? 0 : j + 1;
        }
    }

    // Compute the search direction -H g of BFGS with a dense matrix H. On entry, `direction` holds
    // the previous search direction.
    void dense(const Point& s, const Point& y, double ys, bool curved, bool reset, const Point& g,
               const Point& g_new, Point& direction) {
        if (reset) {
            const double unit = curved ? ys / dot(y, y) : 1.0;
            for (int i = 0; i < kPadded; ++i) {
                matrix_[i] = Point{};
                matrix_[i].at[i] = unit;
            }
            for (int i = 0; i < kRegisters; ++i) direction.reg[i] = -unit * g.reg[i];
        }
        Point found, changed;
        for (int i = 0; i < kRegisters; ++i) found.reg[i] = Vec{};
        for (int j = 0; j < kVariables; ++j) add(found, g_new.at[j], matrix_[j]);
        for (int i = 0; i < kRegisters; ++i) changed.reg[i] = found.reg[i] + direction.reg[i];
        if (!curved) {
            for (int i = 0; i < kRegisters; ++i) direction.reg[i] = -found.reg[i];
            return;
        }
        const double inverse = 1.0 / ys, share = dot(s, g_new) * inverse;
        const double stretch = (1.0 + dot(y, changed) * inverse) * inverse;
        Point mixed;  // H += s mixed' + mixed s'
        for (int i = 0; i < kRegisters; ++i) {
            mixed.reg[i] = 0.5 * stretch * s.reg[i] - inverse * changed.reg[i];
        }
        const double along = dot(mixed, g_new);
        for (int i = 0; i < kRegisters; ++i)
            direction.reg[i] = -found.reg[i] - s.reg[i] * along - mixed.reg[i] * share * ys;
        for (int j = 0; j < kVariables; ++j)
            for (int i = 0; i < kRegisters; ++i)
                matrix_[j].reg[i] += s.at[j] * mixed.reg[i] + mixed.at[j] * s.reg[i];
    }

    const Spline& spline_;
    const Settings given_;
    Point scale_, steps_[kMostMemory], changes_[kMostMemory], matrix_[kPadded];
    double inverse_[kMostMemory], shares_[kMostMemory], costs_[kMostPast], unit_ = 1.0;
    int first_ = 0, count_ = 0, evaluations_ = 0;
};

// Return whether the limits hold at 200 samples and the ball is in the net, with a tolerance of 5
// %.
bool succeeds(const Spline& spline, const Case& task, const Point& x) {
    const double duration = std::exp(x.at[kLogTime]), h = duration / kPieces;
    const Catch at_end = catch_at(spline, task, x, duration);
    double columns[kColumns][3];
    fill_columns(spline, x, at_end.tail, h, columns);
    for (int k = 0; k < 200; ++k) {
        double m[4][3] = {};
        for (int order = 0; order < 4; ++order) {
            const auto row = spline.row(kPieces * k / 199.0, order);
            for (int c = 0; c < kColumns; ++c)
                for (int i = 0; i < 3; ++i)
                    m[order][i] += row[c] * columns[c][i] / std::pow(h, order);
        }
        const auto size2 = [](const double* a) { return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]; };
        const double tau[3] = {m[2][0], m[2][1], m[2][2] + kGravity};
        const double f = std::sqrt(size2(tau));
        double axis[3], turn[3];
        const double along = (tau[0] * m[3][0] + tau[1] * m[3][1] + tau[2] * m[3][2]) / (f * f);
        for (int i = 0; i < 3; ++i) {
            axis[i] = tau[i] / f;
            turn[i] = (m[3][i] - along * tau[i]) / f;
        }
        const double yaw = (axis[1] * turn[0] - axis[0] * turn[1]) / (1.0 + axis[2]);
        if (std::sqrt(size2(m[1])) > 1.05 * kMostSpeed ||
            std::sqrt(size2(turn) + yaw * yaw) > 1.05 * kMostRate ||
            f < 0.95 * kLeastThrust || f > 1.05 * kMostThrust ||
            m[0][2] + kHead[2] < 0.95 * kLeastHeight)
            return false;
    }
    double distance2 = 0.0, speed2 = 0.0, facing = 0.0;
    for (int i = 0; i < 3; ++i) {
        distance2 += at_end.miss[i] * at_end.miss[i];
        speed2 += at_end.ball_vel[i] * at_end.ball_vel[i];
        facing -= at_end.axis[i] * at_end.ball_vel[i];
    }
    const double angle = std::acos(facing / std::sqrt(speed2));
    return std::sqrt(distance2) <= 1.05 * kNetRadius && angle <= 1.05 * std::acos(kSafeCosine);
}

double processor_seconds() {
    timespec now;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &now);
    return double(now.tv_sec) + 1e-9 * double(now.tv_nsec);
}

std::vector<Case> read_cases(const std::string& path) {
    std::ifstream file(path);
    if (!file) throw std::runtime_error("cannot read " + path);
    std::string line, word;
    std::map<std::string, std::size_t> places;
    std::getline(file, line);
    std::istringstream head(line);
    for (std::size_t i = 0; std::getline(head, word, ','); ++i) {
        while (!word.empty() && (word.back() == '\r' || word.back() == ' ')) word.pop_back();
        places[word] = i;
    }
    std::vector<Case> cases;
    while (std::getline(file, line)) {
        std::vector<double> row;
        std::istringstream words(line);
        while (std::getline(words, word, ',')) row.push_back(std::stod(word));
        if (row.empty()) continue;
        const auto at = [&](const std::string& name) { return row.at(places.at(name)); };
        cases.push_back({{{at("b0_x"), at("b0_y"), at("b0_z")},
                          {at("bv0_x"), at("bv0_y"), at("bv0_z")}},
                         at("Tp")});
    }
    return cases;
}

Settings read_settings(int count, char** words) {
    Settings given;
    const std::map<std::string, int*> counts = {
        {"memory", &given.memory}, {"past", &given.past}, {"most_steps", &given.most_steps},
        {"interpolate", &given.interpolate}, {"relative", &given.relative},
        {"repeats", &given.repeats}};
    const std::map<std::string, double*> numbers = {
        {"delta", &given.delta}, {"decrease", &given.decrease}, {"curvature", &given.curvature},
        {"scale_q", &given.scale_q}, {"scale_t", &given.scale_t}, {"scale_p", &given.scale_p},
        {"scale_v", &given.scale_v}, {"scale_a", &given.scale_a}};
    for (int i = 0; i < count; ++i) {
        const std::string word = words[i];
        const auto split = word.find('=');
        const std::string name = word.substr(0, split);
        if (split == std::string::npos || !(counts.count(name) || numbers.count(name)))
            throw std::runtime_error("no such setting: " + word);
        const std::string value = word.substr(split + 1);
        if (counts.count(name))
            *counts.at(name) = std::stoi(value);
        else
            *numbers.at(name) = std::stod(value);
    }
    if (given.memory < 0 || given.memory > kMostMemory || given.past < 1 ||
        given.past > kMostPast || given.repeats < 1)
        throw std::runtime_error("memory is 0 to 64, past 1 to 64, repeats at least 1");
    return given;
}

}  // namespace

int main(int count, char** words) try {
    if (count < 2) throw std::runtime_error("usage: catch FILE [name=value ...]");
    const std::vector<Case> cases = read_cases(words[1]);
    const Settings settings = read_settings(count - 2, words + 2);
    const Spline spline(settings.relative != 0);
    Search search(spline, settings);
    std::vector<Result> results(cases.size());
    double best = std::numeric_limits<double>::infinity();
    for (int round = 0; round < settings.repeats; ++round) {
        const double began = processor_seconds();
        for (std::size_t i = 0; i < cases.size(); ++i) results[i] = search.plan(cases[i]);
        best = std::min(best, processor_seconds() - began);
    }
    std::printf("seconds %.9g\nJ0,cost,T,iterations,evaluations,success\n", best);
    for (std::size_t i = 0; i < cases.size(); ++i)
        std::printf("%.15g,%.15g,%.15g,%d,%d,%d\n", search.guess_cost(cases[i]), results[i].cost,
                    std::exp(results[i].x.at[kLogTime]), results[i].iterations,
                    results[i].evaluations, succeeds(spline, cases[i], results[i].x));
    return 0;
} catch (const std::exception& error) {
    std::fprintf(stderr, "catch: %s\n", error.what());
    return 1;
}
