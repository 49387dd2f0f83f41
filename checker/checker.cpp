// Undertow's second checker of certificates of version 2, written from docs/certificate-format.md alone.
//
//   undertow-checker FILE [--seconds T]     decide every claim; exit status 0 if all are proved, else 1
//   undertow-checker --evaluate FILE        enclosures of an expression graph over boxes, for tests
#include "region.hpp"
#include <cfenv>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <functional>
#include <iostream>
#include <sstream>

using Box = std::vector<Interval>;
using IJ = Jet<Interval>;
using EJ = Jet<Exact>;
enum class Verdict { proved, refuted, undecided };


// ---- Numbers in sentences ------------------------------------------------------------------------

// A decimal with so many digits, rounded towards 0 (away = false) or away from it.
static std::pair<Fraction, std::string> decimals(const Fraction& x, int digits, bool away = false) {
    if (x.sign() == 0) return {0, "0"};
    const Fraction size = x.sign() < 0 ? -x : x;
    const auto ten = [](long k) {
        Whole p(1);
        for (long i = 0; i < std::labs(k); ++i) p = p * 10;
        return k >= 0 ? Fraction(p, 1) : Fraction(Whole(1), p);
    };
    long e = long(std::floor(double(size.top.bits() - size.bottom.bits()) * 0.30103)) - 1;
    while (ten(e + 1) <= size) ++e;  // 10^e <= size < 10^(e+1)
    const Fraction unit = ten(e - digits + 1), count = size / unit;
    Whole q = floor_div(count.top, count.bottom);
    if (away && !(Fraction(q, 1) == count)) q = q + Whole(1);
    const Fraction value = Fraction(q, 1) * unit;
    std::string s = decimal(q);
    long point = e + 1 + long(s.size()) - digits;  // digits before the point
    while (s.size() > 1 && s.back() == '0') s.pop_back();
    std::string text;
    if (point < -3 || point > 15)
        text = s.substr(0, 1) + (s.size() > 1 ? "." + s.substr(1) : "") + "e" + std::to_string(point - 1);
    else if (point <= 0) text = "0." + std::string(size_t(-point), '0') + s;
    else if (size_t(point) >= s.size()) text = s + std::string(size_t(point) - s.size(), '0');
    else text = s.substr(0, size_t(point)) + "." + s.substr(size_t(point));
    return {x.sign() < 0 ? -value : value, x.sign() < 0 ? "-" + text : text};
}
// The decimal of few digits that names the number (equal to it, or its nearest double is it), or "".
static std::string short_name(const Fraction& x) {
    const bool binary = x.top.bits() <= 53 && shift(shift(x.bottom, 1 - x.bottom.bits()), x.bottom.bits() - 1).limb == x.bottom.limb;
    // the size of x is at least 2^(bits - bits - 1), or 2^(bits - bits) if the quotient reaches it
    const Fraction size = x.sign() < 0 ? -x : x;
    long e = x.top.bits() - x.bottom.bits();
    if (size < scaled(1, e)) --e;
    const Fraction half_step = scaled(1, e - 53);
    for (int digits = 1; digits <= 12; ++digits)
        for (const bool away : {false, true}) {
            auto [value, text] = decimals(x, digits, away);
            const Fraction gap = x < value ? value - x : x - value;
            if (gap.sign() == 0 || (binary && gap <= half_step)) return text;
        }
    return "";
}
static std::string exactly(const Fraction& x) {
    const std::string brief = short_name(x);
    if (!brief.empty()) return brief;
    const std::string full = decimal(x.top) + (x.bottom.bits() == 1 ? "" : "/" + decimal(x.bottom));
    return full.size() <= 24 ? full : decimals(x, 12).second + "…";
}
static std::string inwards(const Fraction& x) {
    const std::string brief = short_name(x);
    return brief.empty() ? decimals(x, 6).second : brief;
}
static std::string listed(const std::vector<Fraction>& x) {
    std::string s;
    for (const Fraction& y : x) s += (s.empty() ? "" : ", ") + exactly(y);
    return "[" + s + "]";
}
static std::string listed(const Matrix<Fraction>& a) {
    std::string s;
    for (const auto& row : a) s += (s.empty() ? "" : ", ") + listed(row);
    return "[" + s + "]";
}

// ---- Regions and branch and bound ------------------------------------------------------------------

struct Region {
    std::vector<std::pair<Fraction, Fraction>> sides;

    Region(const Json& j, const Model& model) : sides(model.n) {
        of_kind(j, Json::object, "region");
        for (const auto& [key, value] : j.keys) {
            const auto at = std::find(model.positions.begin(), model.positions.end(), key);
            if (at == model.positions.end()) refuse("a region names something that is no position");
            const auto ends = fractions(value, 2, "side of a region");
            if (ends[0].sign() > 0 || ends[1].sign() < 0) refuse("a region does not hold the target");
            sides[size_t(at - model.positions.begin())] = {ends[0], ends[1]};
        }
    }
    Box box() const {
        Box b;
        for (const auto& [low, high] : sides) b.push_back(hull(Interval(low), Interval(high)));
        return b;
    }
    std::string sentence(const Model& model) const {
        std::string s;
        for (size_t i = 0; i < sides.size(); ++i) {
            const auto& [low, high] = sides[i];
            s += (i ? ", " : "") + model.positions[i] + (low == high ? " = 0" : " in [" + inwards(low) + ", " + inwards(high) + "]");
        }
        return s;
    }
};

// What has to hold at every point of a box: a number > 0, >= 0, or not 0.
struct Goal {
    IJ value;
    enum Wanted { above, not_below, not_zero } wanted;

    bool holds(const Interval& x) const {
        return wanted == above       ? positive(x)
               : wanted == not_below ? not_negative(x)
                                     : positive(x) || negative(x);
    }
    bool fails(const Interval& x) const {
        return wanted == above ? not_positive(x) : wanted == not_below ? negative(x) : is_zero(x);
    }
};
using Goals = std::function<std::vector<Goal>(const std::vector<IJ>&)>;

static Verdict branch_and_bound(const Region& region, const Goals& goals) {
    std::vector<Box> open{region.box()};
    const size_t n = region.sides.size();
    for (size_t boxes = 0; !open.empty(); ++boxes) {
        if (boxes > 400000 || now() > deadline) return Verdict::undecided;
        const Box box = open.back();
        open.pop_back();
        std::vector<IJ> over, middle;
        for (size_t i = 0; i < n; ++i) {
            const double m = std::min(std::max(box[i].low() / 2 + box[i].high / 2, box[i].low()), box[i].high);
            over.push_back(IJ::variable(box[i], i, n));
            // a point of the region itself, else (a side of no width, no double) the side
            const Fraction exact = from_double(m);
            const bool inside = region.sides[i].first <= exact && exact <= region.sides[i].second;
            middle.push_back(IJ(inside ? Interval(m) : box[i]));
        }
        const auto values = goals(over), centre = goals(middle);
        for (const Goal& goal : centre) {
            if (goal.fails(goal.value.v)) return Verdict::refuted;
            if (!goal.value.v.defined()) break;  // what comes later rests on it
        }
        std::vector<double> vary(n, 0.0);
        bool settled = true, all_defined = true;
        for (size_t k = 0; k < values.size(); ++k) {
            Interval mean = centre[k].value.v;
            const auto& g = values[k].value.g;
            for (size_t i = 0; i < g.size(); ++i) mean = mean + g[i] * (box[i] - middle[i].v);
            if (values[k].holds(meet(values[k].value.v, mean))) continue;
            settled = false;
            all_defined &= values[k].value.v.defined();
            for (size_t i = 0; i < g.size(); ++i)
                if (g[i].defined()) vary[i] = std::max(vary[i], g[i].size() * box[i].width());
        }
        if (settled) continue;
        size_t cut = 0;
        for (size_t i = 0; i < n; ++i) {
            if (!all_defined || vary[cut] == 0) vary[i] = std::max(vary[i] * 0, box[i].width());
            if (vary[i] > vary[cut]) cut = i;
        }
        const double m = box[cut].low() / 2 + box[cut].high / 2;
        if (!(box[cut].low() < m && m < box[cut].high)) return Verdict::undecided;
        Box left = box, right = box;
        left[cut] = Interval::between(box[cut].low(), m);
        right[cut] = Interval::between(m, box[cut].high);
        open.push_back(right);
        open.push_back(left);
    }
    return Verdict::proved;
}

static std::vector<Goal> regular(const Geometry<Interval>& g) {
    std::vector<Goal> r;
    for (const IJ& pivot : g.pivots) r.push_back({pivot, Goal::above});
    r.push_back({g.det_B, Goal::not_zero});
    r.push_back({g.det_gamma, Goal::not_zero});
    return r;
}

// ---- The claims ------------------------------------------------------------------------------------

struct Decided {
    Verdict verdict = Verdict::undecided;
    std::string sentence;
};
static const std::vector<IJ> no_rates;

static EJ exact_zero() { return EJ(Exact(0.0)); }
static std::vector<EJ> at_target(size_t n, size_t from, size_t count) {
    std::vector<EJ> r;
    for (size_t i = 0; i < n; ++i) r.push_back(count ? EJ::variable(Exact(0.0), from + i, count) : exact_zero());
    return r;
}
// f_u(0, 0): +1 if all are exactly 0, -1 if one is certainly not, else 0
static int rest(const Model& model, const Plant<Exact>& plant) {
    int r = 1;
    for (size_t i = model.m; i < model.n; ++i) {
        if (positive(plant.f[i].v) || negative(plant.f[i].v)) return -1;
        if (!is_zero(plant.f[i].v)) r = 0;
    }
    return r;
}

static Verdict stability(const Model& model, const Law& law, const Fraction& rate) {
    const size_t n = model.n, m = model.m, u = n - m, N = 2 * n - m;
    const auto plant = model.at<Exact>(at_target(n, 0, 2 * n), at_target(n, n, 2 * n));
    const int at_rest = rest(model, plant);
    if (at_rest < 0) return Verdict::refuted;
    const Geometry<Exact> geometry(model, law, plant);
    bool unsure = at_rest == 0;
    for (const EJ& pivot : geometry.pivots) {
        if (not_positive(pivot.v)) return Verdict::refuted;
        if (!positive(pivot.v)) return Verdict::undecided;
    }
    const auto values = [](const Matrix<Fraction>& a) {
        Matrix<Exact> r;
        for (const auto& row : a) r.emplace_back(row.begin(), row.end());
        return r;
    };
    const auto alpha_a = values(law.alpha_a), alpha_u = values(law.alpha_u);
    const auto lambda_a = values(law.lambda_a), lambda_u = values(law.lambda_u);
    if (is_zero(determinant(alpha_a))) return Verdict::refuted;
    const auto inverse_a = inverse(alpha_a);
    Matrix<Exact> C(m, std::vector<Exact>(N));  // λ_a q_a + λ_u q_u + α_u v_u as rows over z
    Matrix<Exact> pick(u, std::vector<Exact>(N));
    for (size_t i = 0; i < m; ++i) {
        for (size_t j = 0; j < m; ++j) C[i][j] = lambda_a[i][j];
        for (size_t j = 0; j < u; ++j) C[i][m + j] = lambda_u[i][j], C[i][n + j] = alpha_u[i][j];
    }
    for (size_t j = 0; j < u; ++j) pick[j][n + j] = Exact(1.0);
    Matrix<Exact> V = product(inverse_a, C);
    for (auto& row : V)
        for (Exact& x : row) x = -x;
    Matrix<Exact> Z(2 * n, std::vector<Exact>(N)), slopes(u, std::vector<Exact>(2 * n)), M_ua(u), M_uu(u);
    for (size_t i = 0; i < n; ++i) Z[i][i] = Exact(1.0);
    for (size_t i = 0; i < m; ++i) Z[n + i] = V[i];
    for (size_t i = 0; i < u; ++i) Z[n + m + i] = pick[i];
    for (size_t i = 0; i < u; ++i) {
        for (size_t j = 0; j < plant.f[m + i].g.size(); ++j) slopes[i][j] = plant.f[m + i].g[j];
        for (size_t j = 0; j < m; ++j) M_ua[i].push_back(plant.M[m + i][j].v);
        for (size_t j = 0; j < u; ++j) M_uu[i].push_back(plant.M[m + i][m + j].v);
    }
    const auto coupling = product(M_ua, inverse_a);
    const auto E = sum(M_uu, product(coupling, alpha_u), true);
    const Exact det_E = determinant(E);
    if (is_zero(det_E)) return Verdict::refuted;
    const auto moved = sum(product(lambda_a, V), product(lambda_u, pick));
    const auto accelerations = product(inverse(E), sum(product(slopes, Z), product(coupling, moved)));
    Matrix<Exact> A = V;
    A.insert(A.end(), pick.begin(), pick.end());
    A.insert(A.end(), accelerations.begin(), accelerations.end());
    for (size_t i = 0; i < N; ++i) A[i][i] = A[i][i] + Exact(rate);
    // characteristic polynomial (Faddeev and LeVerrier), the highest power first
    std::vector<Exact> c{Exact(1.0)};
    Matrix<Exact> K(N, std::vector<Exact>(N));
    for (size_t i = 0; i < N; ++i) K[i][i] = Exact(1.0);
    for (size_t k = 1; k <= N; ++k) {
        if (now() > deadline) return Verdict::undecided;
        K = product(A, K);
        Exact trace;
        for (size_t i = 0; i < N; ++i) trace = trace + K[i][i];
        c.push_back(-(trace / Exact(double(k))));
        for (size_t i = 0; i < N; ++i) K[i][i] = K[i][i] + c.back();
    }
    std::vector<Exact> row, next;
    for (size_t i = 0; i <= N; ++i) (i % 2 ? next : row).push_back(c[i]);
    for (size_t k = 0; k <= N; ++k) {
        if (not_positive(row[0])) return Verdict::refuted;
        if (!positive(row[0])) return Verdict::undecided;
        if (k == N) break;
        std::vector<Exact> after;
        next.resize(std::max(next.size(), size_t(1)));
        if (!next[0].defined()) return Verdict::undecided;
        if (k + 1 < N && (positive(next[0]) || negative(next[0])))
            for (size_t i = 0; i + 1 < row.size(); ++i)
                after.push_back(row[i + 1] - row[0] * (i + 1 < next.size() ? next[i + 1] : Exact()) / next[0]);
        row = next;
        next = after;
    }
    return unsure ? Verdict::undecided : Verdict::proved;
}

static Verdict nonsingular(const Model& model, const Law& law, const Region& region, const Fraction& ratio) {
    const auto plant = model.at<Exact>(at_target(model.n, 0, 0), at_target(model.n, 0, 0), false);
    const Exact zero = Geometry<Exact>(model, law, plant).det_gamma.v;
    if (is_zero(zero)) return Verdict::refuted;
    if (!zero.defined()) return Verdict::undecided;
    const IJ at_zero(hull(Interval(zero.low), Interval(zero.high))), least{Interval(ratio)};
    return branch_and_bound(region, [&](const std::vector<IJ>& q) {
        const Geometry<Interval> g(model, law, model.at<Interval>(q, no_rates, false));
        auto goals = regular(g);
        goals.push_back({g.det_gamma / at_zero - least, Goal::not_below});
        return goals;
    });
}

static Verdict reaching(const Model& model, const Law& law, const Region& region,
                        const std::vector<Fraction>& disturbance, const std::vector<Fraction>& rate) {
    return branch_and_bound(region, [&](const std::vector<IJ>& q) {
        const Geometry<Interval> g(model, law, model.at<Interval>(q, no_rates, false));
        auto goals = regular(g);
        const auto k = g.gains(law);
        const auto W = g.force_rows(law);
        for (size_t i = 0; i < model.m; ++i) {
            IJ margin = k[i] - IJ(Interval(rate[i]));
            for (size_t j = 0; j < model.n; ++j)
                if (disturbance[j].sign()) margin = margin - size_of(W[i][j]) * IJ(Interval(disturbance[j]));
            goals.push_back({margin, Goal::not_below});
        }
        return goals;
    });
}

// The closed loop of section 4, s/ε or tanh(s/ε) in place of σ, the input not limited.
struct Loop {
    std::vector<IJ> motion, demand, surface;
    Loop(const Model& model, const Law& law, const Geometry<Interval>& g, const Plant<Interval>& p,
         const std::vector<IJ>& q, const std::vector<IJ>& v) {
        const size_t n = model.n, m = model.m;
        using Vector = std::vector<IJ>;
        const Vector qa(q.begin(), q.begin() + long(m)), qu(q.begin() + long(m), q.end());
        const Vector va(v.begin(), v.begin() + long(m)), vu(v.begin() + long(m), v.end());
        const Vector fa(p.f.begin(), p.f.begin() + long(m)), fu(p.f.begin() + long(m), p.f.end());
        const auto aa = constants<Interval>(law.alpha_a), la = constants<Interval>(law.lambda_a);
        const auto au = constants<Interval>(law.alpha_u), lu = constants<Interval>(law.lambda_u);
        const auto plus = [](Vector x, const Vector& y, bool minus = false) {
            for (size_t i = 0; i < x.size(); ++i) x[i] = minus ? x[i] - y[i] : x[i] + y[i];
            return x;
        };
        surface = plus(plus(product(aa, va), product(la, qa)), plus(product(au, vu), product(lu, qu)));
        const Vector y = g.solve(fu, 0, n - m);
        Vector pull = plus(product(au, y), plus(product(la, va), product(lu, vu)));
        const auto k = g.gains(law);
        for (size_t i = 0; i < m; ++i) {
            const IJ s = surface[i] / IJ(Interval(law.layer[i]));
            pull[i] = pull[i] + k[i] * (law.switching == "tanh" ? tanh_of(s) : s);
        }
        Vector w = product(inverse(g.gamma), pull);
        for (IJ& x : w) x = -x;
        Matrix<IJ> M_au(m);
        for (size_t i = 0; i < m; ++i) M_au[i].assign(p.M[i].begin() + long(m), p.M[i].end());
        const Vector h = plus(fa, product(M_au, y), true);
        demand = product(inverse(p.B), plus(product(g.S, w), h, true));
        motion = v;
        motion.insert(motion.end(), w.begin(), w.end());
        const Vector a_u = plus(y, product(g.X, w), true);
        motion.insert(motion.end(), a_u.begin(), a_u.end());
    }
};

static Interval norm(const std::vector<Interval>& x) {
    Interval s(0.0);
    for (const Interval& y : x) s = s + power(y, 2);
    if (!s.defined()) return s;
    return positive(s) ? root(s) : Interval::between(0, std::sqrt(s.high));
}

// Gauss and Jordan in fractions; empty if there is no inverse.
static Matrix<Fraction> exact_inverse(Matrix<Fraction> a) {
    const size_t n = a.size();
    for (size_t i = 0; i < n; ++i)
        for (size_t j = 0; j < n; ++j) a[i].push_back(i == j ? 1 : 0);
    for (size_t k = 0; k < n; ++k) {
        size_t p = k;
        while (p < n && a[p][k].sign() == 0) ++p;
        if (p == n) return {};
        std::swap(a[p], a[k]);
        const Fraction pivot = a[k][k];
        for (Fraction& x : a[k]) x = x / pivot;
        for (size_t i = 0; i < n; ++i) {
            if (i == k || a[i][k].sign() == 0) continue;
            const Fraction by = a[i][k];
            for (size_t j = 0; j < 2 * n; ++j) a[i][j] = a[i][j] - by * a[k][j];
        }
    }
    for (auto& row : a) row.erase(row.begin(), row.begin() + long(n));
    return a;
}

static Matrix<Interval> enclosed(const Matrix<Fraction>& a) {
    Matrix<Interval> r;
    for (const auto& row : a) {
        r.emplace_back();
        for (const Fraction& x : row) r.back().push_back(Interval(x));
    }
    return r;
}

// Symmetric G: a congruence with the inverse of a Cholesky factor of the middle makes it nearly the
// identity, and one with a diagonal of weights, found by Gauss and Seidel, gives the dominance of the
// diagonal, if any weights do. Neither the factor nor the weights need be right: they are only tried.
static bool positive_definite(const Matrix<Interval>& G) {
    const size_t n = G.size();
    Matrix<double> L(n, std::vector<double>(n, 0.0)), R = L;
    for (size_t i = 0; i < n; ++i)
        for (size_t j = 0; j <= i; ++j) {
            double s = G[i][j].low() / 2 + G[i][j].high / 2;
            for (size_t k = 0; k < j; ++k) s -= L[i][k] * L[j][k];
            if (i == j && !(s > 0)) return false;
            L[i][j] = i == j ? std::sqrt(s) : s / L[j][j];
        }
    for (size_t j = 0; j < n; ++j)
        for (size_t i = j; i < n; ++i) {
            double s = i == j ? 1.0 : 0.0;
            for (size_t k = j; k < i; ++k) s -= L[i][k] * R[k][j];
            R[i][j] = s / L[i][i];
        }
    Matrix<Interval> C(n);  // lower triangular with a diagonal that is not 0: invertible
    for (size_t i = 0; i < n; ++i)
        for (size_t j = 0; j < n; ++j) C[i].push_back(Interval(R[i][j]));
    for (size_t i = 0; i < n; ++i)
        if (!positive(C[i][i])) return false;
    const auto D = product(product(C, G), transposed(C));
    std::vector<double> weight(n, 1.0);
    for (int round = 0; round < 200; ++round)
        for (size_t i = 0; i < n; ++i) {
            double others = 1.0;
            for (size_t j = 0; j < n; ++j)
                if (j != i) others += D[i][j].size() * weight[j];
            weight[i] = others / D[i][i].low();
        }
    for (size_t i = 0; i < n; ++i) {
        Interval rest = D[i][i] * Interval(weight[i]);
        for (size_t j = 0; j < n; ++j)
            if (j != i) rest = rest - Interval(std::max(D[i][j].size(), D[j][i].size())) * Interval(weight[j]);
        if (!(weight[i] > 0) || !positive(rest)) return false;
    }
    return true;
}

static Verdict terminal(const Model& model, const Law& law, const Matrix<Fraction>& W, const Fraction& radius) {
    const size_t n = model.n, m = model.m;
    const auto inverse_W = exact_inverse(W);
    if (inverse_W.empty()) return Verdict::refuted;
    const auto exact = model.at<Exact>(at_target(n, 0, 0), at_target(n, 0, 0));
    const int at_rest = rest(model, exact);
    if (at_rest < 0) return Verdict::refuted;
    if (at_rest == 0) return Verdict::undecided;
    const auto V = enclosed(inverse_W);
    const Interval rho(radius);
    Matrix<Fraction> C(m);  // s = C x
    for (size_t i = 0; i < m; ++i)
        for (const auto* part : {&law.lambda_a, &law.lambda_u, &law.alpha_a, &law.alpha_u})
            C[i].insert(C[i].end(), (*part)[i].begin(), (*part)[i].end());
    bool sure = true;
    const auto reach = product(enclosed(C), V);
    for (size_t i = 0; i < m; ++i) {
        const Interval room = Interval(law.layer[i]) - rho * norm(reach[i]);
        if (negative(room)) return Verdict::refuted;  // the largest |s_i| on the ellipsoid is just this
        sure &= not_negative(room);
    }
    std::vector<IJ> q, v, q0, v0;
    for (size_t i = 0; i < 2 * n; ++i) {
        const double half = (rho * norm(V[i])).high;
        if (!std::isfinite(half)) return Verdict::undecided;
        (i < n ? q : v).push_back(IJ::variable(Interval::between(-half, half), i, 2 * n));
        (i < n ? q0 : v0).push_back(IJ(Interval(0.0)));
    }
    const auto plant0 = model.at<Interval>(q0, v0);
    const Geometry<Interval> geometry0(model, law, plant0);
    for (const Goal& goal : regular(geometry0))
        if (goal.fails(goal.value.v)) return Verdict::refuted;
        else if (!goal.value.v.defined()) return Verdict::undecided;
    const auto plant = model.at<Interval>(q, v);
    const Geometry<Interval> geometry(model, law, plant);
    for (const Goal& goal : regular(geometry)) sure &= goal.holds(goal.value.v);
    for (const IJ& x : plant.f) sure &= x.v.defined();
    if (!sure) return Verdict::undecided;
    const Loop loop(model, law, geometry, plant, q, v), loop0(model, law, geometry0, plant0, q0, v0);
    const auto rows = [&](const std::vector<IJ>& x) {
        Matrix<Interval> r;
        for (const IJ& y : x) {
            r.push_back(y.g);
            r.back().resize(2 * n, Interval(0.0));
        }
        return r;
    };
    const auto slopes = product(rows(loop.demand), V);
    for (size_t i = 0; i < m; ++i) {
        if (!loop.demand[i].v.defined()) return Verdict::undecided;
        if (!model.limited[i]) continue;
        const Interval largest = Interval(loop0.demand[i].v.size()) + rho * norm(slopes[i]);
        if (!not_negative(Interval(model.limits[i]) - largest)) return Verdict::undecided;
    }
    const auto turned = product(product(enclosed(W), rows(loop.motion)), V);
    Matrix<Interval> G = sum(turned, transposed(turned));
    for (auto& row : G)
        for (Interval& x : row) {
            x = -x;
            if (!x.defined()) return Verdict::undecided;
        }
    return positive_definite(G) ? Verdict::proved : Verdict::undecided;
}

// Whether M is shown even and f odd in (q, v): 1 even, -1 odd, 0 not known.
static bool odd_motion(const Model& model) {
    std::vector<int> sign(model.nodes.size(), 0);
    for (size_t i = 0; i < sign.size(); ++i) {
        const Node& node = model.nodes[i];
        const int a = has_operands(node.op) ? sign[node.a] : 0, b = has_two(node.op) ? sign[node.b] : a;
        switch (node.op) {
        case Op::number: case Op::pi: case Op::parameter: sign[i] = 1; break;
        case Op::position: case Op::velocity: sign[i] = -1; break;
        case Op::add: case Op::sub: sign[i] = a == b ? a : 0; break;
        case Op::mul: case Op::div: sign[i] = a * b; break;
        case Op::pow: sign[i] = node.b % 2 ? a : a * a; break;
        case Op::neg: case Op::sin: case Op::tanh: sign[i] = a; break;
        case Op::cos: sign[i] = a * a; break;
        default: sign[i] = a == 1;
        }
    }
    bool good = true;
    for (const auto& row : model.M)
        for (size_t k : row) good &= sign[k] == 1;
    for (size_t k : model.f) good &= sign[k] == -1;
    return good;
}

// No point of a box has f >= 0, a <= 1 and b >= 1: f + λ (1 - a) + μ (b - 1) < 0 there for some λ, μ >= 0.
static bool excluded(const Quadratic& f, const Quadratic& a, const Quadratic& b) {
    double fa = 0, fb = 0, aa = 0, ab = 0, bb = 0;
    for (size_t i = 0; i < Quadratic::V; ++i) {
        fa += f.g[i] * a.g[i], fb += f.g[i] * b.g[i], aa += a.g[i] * a.g[i];
        ab += a.g[i] * b.g[i], bb += b.g[i] * b.g[i];
    }
    const double gap = aa * bb - ab * ab;
    const double tried[4][3] = {{1, fa / aa, 0}, {1, 0, -fb / bb}, {1, (fa * bb - fb * ab) / gap, (fa * ab - fb * aa) / gap}, {0, 1, ab / bb}};
    for (const auto& [one, l, u] : tried) {
        const double lambda = l > 0 ? l : 0, mu = u > 0 ? u : 0;
        if (!std::isfinite(lambda + mu)) continue;
        const Quadratic sum = Quadratic(one) * f + Quadratic(lambda) * (Quadratic(1.0) - a) + Quadratic(mu) * (b - Quadratic(1.0));
        if (negative(sum.range())) return true;
    }
    return false;
}

static Verdict one_function(const Model& model, const Law& law, const SurfaceRegion& claim, size_t index, bool odd) {
    const size_t N = claim.N, all = N + claim.plant.size();
    const Lyapunov& own = claim.functions[index];
    const Stretch& stretch = claim.stretch;
    const auto size = [](const Fraction& x) { return x.sign() < 0 ? -x : x; };
    Fraction low(0), a = stretch.S.empty() ? Fraction(1) / size(own.G[0][0]) : stretch.pole;
    for (int i = 0; i < 60 && !stretch.S.empty(); ++i) {
        const Fraction middle = (low + a) / Fraction(2);
        (size(own.G[0][0]) * stretch.first(middle) >= Fraction(1) ? a : low) = middle;
    }
    if (!stretch.S.empty() && a >= stretch.pole) return Verdict::undecided;  // the guard reaches the pole
    const Fraction top = stretch.first(a), chord = top / a;
    Box side, values;
    for (size_t i = 0; i < N; ++i) side.push_back(Interval(i ? Fraction(1) + size(own.G[i][0]) * (top - a) : a));
    for (const auto& [k, ends] : claim.plant) values.push_back(hull(Interval(ends.first), Interval(ends.second)));
    using QJ = Jet<Quadratic>;
    const Surface<Interval> plain(model, law, claim);
    const Surface<Quadratic> smooth(model, law, claim);
    const Surface<Interval>::Function V(own), before(claim.functions[index ? index - 1 : 0]);
    const Surface<Quadratic>::Function VQ(own), beforeQ(claim.functions[index ? index - 1 : 0]);
    const IJ chord_i{Interval(chord)};
    const QJ chord_q{Quadratic::constant(chord)};
    std::vector<double> core(N, 0.0);
    const std::vector<IJ> plant(values.begin(), values.end());
    for (int tries = 0; index == 0; ++tries) {
        // ∇V = [G] x and ż = [Z] x on a cube, so V̇ = xᵀ Gᵀ Z x
        if (tries == 30) return Verdict::undecided;
        std::vector<IJ> x;
        for (size_t i = 0; i < N; ++i) {
            core[i] = tries ? core[i] / 1.6 : side[i].high / 4;
            x.push_back(IJ::variable(Interval::between(-core[i], core[i]), i, N));
        }
        const auto at = plain.at(V, chord_i, x, plant);
        bool good = true;
        for (const IJ& pivot : at.pivots) good &= positive(pivot.v);
        Matrix<Interval> G, Z;
        for (size_t j = 0; j < N; ++j) {
            std::vector<IJ> way(N);
            way[j] = IJ(Interval(1.0));
            G.push_back(V.value(at.z, way).second.g);
            Z.push_back(at.dz[j].g);
            G.back().resize(N, Interval(0.0));
            Z.back().resize(N, Interval(0.0));
        }
        const auto Q = product(transposed(G), Z);
        Matrix<Interval> H = sum(Q, transposed(Q));
        for (auto& row : H)
            for (Interval& v : row) v = -v, good &= v.defined();
        if (good && positive_definite(H)) break;
    }
    Quadratic::V = all;
    Box start;
    for (size_t i = 0; i < N; ++i) start.push_back(Interval::between(-side[i].high, odd && i + 1 == N ? 0 : side[i].high));
    start.insert(start.end(), values.begin(), values.end());
    std::vector<Box> open{start};
    for (size_t boxes = 0; !open.empty(); ++boxes) {
        if (boxes > 20000000 || now() > deadline) return Verdict::undecided;
        const Box box = open.back();
        open.pop_back();
        std::vector<QJ> x;
        bool home = index == 0;
        for (size_t i = 0; i < all; ++i) {
            x.push_back(QJ(Quadratic::variable(box[i], i)));
            if (i < N) home &= box[i].size() <= core[i];
        }
        const auto at = smooth.at(VQ, chord_q, {x.begin(), x.begin() + long(N)}, {x.begin() + long(N), x.end()});
        const auto [value, rate] = VQ.value(at.z, at.dz);
        const Interval guard = VQ.guard(at.c).v.range(), one(1.0);
        if (positive(value.v.range() - one) || positive(guard - one)) continue;
        bool inside = negative(guard - one), near = true, regular = true, falls = negative(rate.v.range());
        Quadratic other(1.0);
        if (index) {
            other = beforeQ.value(product(beforeQ.A, at.c)).first.v;
            near = negative(beforeQ.guard(at.c).v.range() - one);
            home = near && negative(other.range() - one);
        }
        for (const QJ& pivot : at.pivots) regular &= positive(pivot.v.range());
        falls = falls || (inside && near && excluded(rate.v, value.v, other));
        if (inside && (home || (falls && regular))) continue;
        size_t cut = 0;
        double most = -1, widest = 0;
        for (size_t i = 0; i < all; ++i) widest = std::max(widest, box[i].width() / start[i].width());
        for (size_t i = 0, k = 0; i < all; ++i) {
            double vary = std::fabs(rate.v.g[i]) + std::fabs(rate.v.h[k]);
            for (size_t j = 0, at_j = 0; j < all; at_j += all - j, ++j)
                if (j != i) vary += std::fabs(rate.v.h[j < i ? at_j + i - j : k + j - i]) / 2;
            k += all - i;
            const double width = start[i].width() > 0 ? box[i].width() / start[i].width() : 0;
            if (!std::isfinite(rate.v.e)) vary = width;
            if (width > 0.02 * widest && vary > most) most = vary, cut = i;
        }
        if (widest < 1e-3 || boxes % 64 == 0) {  // a point of the set where it is false?
            std::vector<IJ> point;
            for (const Box::value_type& b : box) point.push_back(IJ(Interval(b.low() / 2 + b.high / 2)));
            const auto here = plain.at(V, chord_i, {point.begin(), point.begin() + long(N)}, {point.begin() + long(N), point.end()});
            const auto [v, r] = V.value(here.z, here.dz);
            const bool held = not_negative(one - v.v) && not_negative(one - V.guard(here.c).v);
            bool wrong = positive(r.v) && (!index || positive(before.value(product(before.A, here.c)).first.v - one));
            for (const IJ& pivot : here.pivots) wrong |= not_positive(pivot.v);
            if (held && wrong) return Verdict::refuted;
        }
        const double m = box[cut].low() / 2 + box[cut].high / 2;
        if (widest < 1e-7 || !(box[cut].low() < m && m < box[cut].high)) return Verdict::undecided;
        open.push_back(box);
        open.back()[cut] = Interval::between(m, box[cut].high);
        open.push_back(box);
        open.back()[cut] = Interval::between(box[cut].low(), m);
    }
    return Verdict::proved;
}

static Verdict surface_region(const Model& model, const Law& law, const SurfaceRegion& claim) {
    if (claim.N + claim.plant.size() > 8) return Verdict::undecided;
    const Surface<Exact> exact(model, law, claim);
    std::vector<EJ> rest(claim.N, exact_zero()), plant, pivots;
    for (const auto& [k, ends] : claim.plant) plant.push_back(EJ(hull(Exact(ends.first), Exact(ends.second))));
    for (const EJ& rate : exact.rates(rest, plant, pivots))
        if (!is_zero(rate.v)) return positive(rate.v) || negative(rate.v) ? Verdict::refuted : Verdict::undecided;
    const bool odd = odd_motion(model);
    for (size_t k = 0; k < claim.functions.size(); ++k)
        if (const Verdict v = one_function(model, law, claim, k, odd); v != Verdict::proved) return v;
    const Surface<Interval> plain(model, law, claim);
    const Surface<Interval>::Function V(claim.functions.back());
    std::vector<Interval> open{Interval::between(0, 1)};
    for (size_t count = 0; !open.empty(); ++count) {  // the line from 0 to what is contained
        const Interval part = open.back();
        open.pop_back();
        const double m = part.low() / 2 + part.high / 2;
        const auto room = [&](const IJ& t) {
            std::vector<IJ> y;
            for (const Fraction& v : claim.contains) y.push_back(t * IJ(Interval(v)));
            const auto c = product(plain.bend(y[0]).first, y);
            const IJ one(Interval(1.0));
            return std::array<IJ, 2>{one - V.value(product(V.A, c)).first, one - V.guard(c)};
        };
        const auto over = room(IJ::variable(part, 0, 1)), middle = room(IJ(Interval(m)));
        bool good = true;
        for (size_t i = 0; i < 2; ++i) {
            if (negative(middle[i].v)) return Verdict::refuted;
            const Interval slope = over[i].g.empty() ? Interval(0.0) : over[i].g[0];
            good &= not_negative(meet(over[i].v, middle[i].v + slope * (part - Interval(m))));
        }
        if (good) continue;
        if (count > 100000 || !(part.low() < m && m < part.high)) return Verdict::undecided;
        open.push_back(Interval::between(part.low(), m));
        open.push_back(Interval::between(m, part.high));
    }
    return Verdict::proved;
}

static Decided decide(const Json& claim, const Model& model, const Law& law, bool read_only) {
    of_kind(claim, Json::object, "claim");
    if (!claim.keys.count("kind")) refuse("a claim lacks the key kind");
    const std::string kind = of_kind(claim.keys.at("kind"), Json::text, "kind").string;
    const size_t n = model.n, m = model.m;
    const auto key = [&](const char* k) -> const Json& { return claim.keys.at(k); };
    const std::string about =
        " Law: alpha_a = " + listed(law.alpha_a) + ", lambda_a = " + listed(law.lambda_a) + ", alpha_u = " +
        listed(law.alpha_u) + ", lambda_u = " + listed(law.lambda_u) + ", eta = " + listed(law.eta) +
        ", layer = " + listed(law.layer) + ", " + law.switching +
        (law.robust ? ", gains for the disturbance " + listed(law.disturbance) : "") + ".";
    Decided r;
    if (kind == "stability") {
        only_keys(claim, {"kind", "rate"}, "claim", true);
        const Fraction rate = fraction(key("rate"), 0);
        r.sentence = "stability: motions on s = 0 that start near enough to the target (how near is not said) converge to it "
                     "exponentially, at " + inwards(rate) + " 1/s or faster; plant as in the file, no disturbance, input not limited." + about;
        if (!read_only) r.verdict = stability(model, law, rate);
    } else if (kind == "nonsingular") {
        only_keys(claim, {"kind", "region", "ratio"}, "claim", true);
        const Region region(key("region"), model);
        const Fraction ratio = fraction(key("ratio"), 1);
        r.sentence = "nonsingular: for " + region.sentence(model) + " M is positive definite, B is invertible, and det Γ is at least " +
                     inwards(ratio) + " of its value at the target; plant as in the file; nothing is said of motions." + about;
        if (!read_only) r.verdict = nonsingular(model, law, region, ratio);
    } else if (kind == "reaching") {
        only_keys(claim, {"kind", "region", "disturbance", "rate"}, "claim", true);
        const Region region(key("region"), model);
        const auto g = fractions(key("disturbance"), n, "disturbance", 0);
        const auto rate = fractions(key("rate"), m, "rate", 0);
        if (law.switching == "tanh") refuse("reaching is not for tanh");
        r.sentence = "reaching: for " + region.sentence(model) + ", forces of at most [";
        for (size_t j = 0; j < n; ++j) r.sentence += (j ? ", " : "") + inwards(g[j]);
        r.sentence += "] and the plant of the file, |s_i| falls at [";
        for (size_t i = 0; i < m; ++i) r.sentence += (i ? ", " : "") + inwards(rate[i]);
        r.sentence += "] or faster outside of the layer, the input renewed at every instant and not limited; motions that leave these positions are not covered." + about;
        if (!read_only) r.verdict = reaching(model, law, region, g, rate);
    } else if (kind == "terminal ellipsoid") {
        only_keys(claim, {"kind", "W", "radius"}, "claim", true);
        const auto W = fraction_matrix(key("W"), 2 * n, 2 * n, "W");
        const Fraction radius = fraction(key("radius"), 1);
        if (law.switching == "sign") refuse("a terminal ellipsoid is not for sign");
        r.sentence = "terminal ellipsoid: no motion leaves {|W x| <= " + inwards(radius) + "} and each converges to the target, inside of the layer and of";
        for (size_t i = 0; i < m; ++i)
            r.sentence += (i ? ", " : " ") + (model.limited[i] ? "|" + model.inputs[i] + "| <= " + exactly(model.limits[i]) : model.inputs[i] + " unlimited");
        r.sentence += "; input renewed at every instant, plant as in the file, no disturbance." + about;
        if (!read_only) r.verdict = terminal(model, law, W, radius);
    } else if (kind == "surface region") {
        const SurfaceRegion region(claim, model);
        r.sentence = "surface region: motions on s = 0 from a compact set that contains the line from the target to (q_u, v_u, w) = [";
        const auto away = std::count_if(region.contains.begin(), region.contains.end(), [](const Fraction& x) { return x.sign() != 0; });
        for (size_t i = 0; i < region.N; ++i)  // one entry may be rounded: then the point stays on the line
            r.sentence += (i ? ", " : "") + (away > 1 ? exactly(region.contains[i]) : inwards(region.contains[i]));
        r.sentence += "] stay in the union of " + std::to_string(region.functions.size()) + " such sets, regular all the way, and converge to the target; ";
        for (const auto& [k, ends] : region.plant)
            r.sentence += model.parameter_names[k] + " in [" + exactly(ends.first) + ", " + exactly(ends.second) + "], ";
        r.sentence += "plant else as in the file, no disturbance, input not limited." + about;
        if (!read_only) r.verdict = surface_region(model, law, region);
    } else if (kind == "closed loop") {
        only_keys(claim, {"kind", "starts", "period", "plant", "disturbance", "ball"}, "claim", true);
        r.sentence = "closed loop: this checker follows no motions, so does not decide it." + about;
    } else
        refuse("an unknown kind of claim");
    return r;
}

// ---- The program -------------------------------------------------------------------------------------

static int check(const std::string& text, double seconds) {
    const Json document = Parser(text).document();
    of_kind(document, Json::object, "document");
    if (!document.keys.count("format") || document.keys.at("format").canonical() != "\"undertow-certificate\"")
        refuse("not a certificate of Undertow");
    if (!document.keys.count("version") || document.keys.at("version").canonical() != "2")
        refuse("not of version 2: make it again with undertow certify");
    only_keys(document, {"format", "version", "model", "model_hash", "subjects", "made_with", "checksum"}, "document");
    const auto signature = [&](const char* key) { return of_kind(document.keys.at(key), Json::text, key).string; };
    if (sha256(document.canonical("checksum")) != signature("checksum")) refuse("the checksum does not fit");
    if (sha256(document.keys.at("model").canonical()) != signature("model_hash")) refuse("the hash of the model does not fit");
    for (const auto& [key, value] : of_kind(document.keys.at("made_with"), Json::object, "made_with").keys) {
        name(key);
        if (value.kind != Json::null) label(value, 64, "made_with");
    }
    const Model model(document.keys.at("model"));
    struct Item {
        Law law;
        const Json* claim;
    };
    std::vector<Item> items;
    for (const Json& subject : list(document.keys.at("subjects"), 1, 1000, "subjects")) {
        only_keys(subject, {"law", "claims"}, "subject");
        const Law law(subject.keys.at("law"), model);
        for (const Json& claim : list(subject.keys.at("claims"), 0, 1000, "claims")) {
            items.push_back({law, &claim});
            decide(claim, model, law, true);
        }
    }
    if (items.empty() || items.size() > 1000) refuse("a file has 1 to 1,000 claims");
    std::cout << "model:";
    for (size_t i = 0; i < model.parameters.size(); ++i)
        std::cout << " " << model.parameter_names[i] << " = " << exactly(model.parameters[i]);
    std::cout << "\n";
    size_t proved = 0;
    for (size_t i = 0; i < items.size(); ++i) {
        const double start = now();
        Decided r = decide(*items[i].claim, model, items[i].law, true);
        deadline = start + seconds;
        try {
            r = decide(*items[i].claim, model, items[i].law, false);
        } catch (const Late&) {  // undecided
        }
        deadline = HUGE_VAL;
        const char* const word = r.verdict == Verdict::proved ? "proved" : r.verdict == Verdict::refuted ? "refuted" : "undecided";
        std::printf("claim %zu: %s, %.4f s\n", i + 1, word, now() - start);
        std::printf("    %s\n", r.sentence.c_str());
        proved += r.verdict == Verdict::proved;
    }
    std::printf("%zu of %zu claims proved\n", proved, items.size());
    return proved == items.size() ? 0 : 1;
}

// A list of {"nodes", "positions", "velocities"} (boxes, lists of pairs): for the last node of each its
// enclosure and those of its derivatives as doubles, and, at points, the enclosure in fractions.
static int evaluate_all(const std::string& text) {
    const Json cases = Parser(text).document();
    for (const Json& item : list(cases, 0, 1000000, "cases")) {
        only_keys(item, {"nodes", "positions", "velocities"}, "case");
        const size_t n = list(item.keys.at("positions"), 1, 12, "positions").size();
        const auto nodes = read_nodes(item.keys.at("nodes"), n, 0);
        const auto needed = needed_for(nodes, {nodes.size() - 1});
        std::array<std::vector<IJ>, 2> x;
        std::array<std::vector<EJ>, 2> e;
        for (const int part : {0, 1})
            for (const Json& pair : list(item.keys.at(part ? "velocities" : "positions"), n, n, "box")) {
                const auto ends = fractions(pair, 2, "side");
                const size_t at = x[part].size() + part * n;
                x[part].push_back(IJ::variable(hull(Interval(ends[0]), Interval(ends[1])), at, 2 * n));
                e[part].push_back(EJ(Exact(ends[0], ends[1])));
            }
        IJ r = evaluate<Interval>(nodes, needed, leaves_of<Interval>(nodes, needed, {}), x[0], x[1]).back();
        r.g.resize(2 * n, Interval(0.0));
        std::printf("%a %a", r.v.low(), r.v.high);
        for (const Interval& g : r.g) std::printf(" %a %a", g.low(), g.high);
        const Exact exact = evaluate<Exact>(nodes, needed, leaves_of<Exact>(nodes, needed, {}), e[0], e[1]).back().v;
        if (exact.defined())
            for (const Fraction* f : {&exact.low, &exact.high})
                std::printf(" %s/%s", decimal(f->top).c_str(), decimal(f->bottom).c_str());
        std::printf("\n");
    }
    return 0;
}

static bool rounds_up() {
    std::fesetround(FE_UPWARD);
    volatile double one = 1.0, three = 3.0, tiny = 0x1p-80, two = 2.0;
    volatile double up = one + tiny, above = tiny - one, third = one / three, minus = (-one) / three;
    volatile double product = up * up, least = std::sqrt(two);
    return up > 1.0 && above > -1.0 && third > -minus && product > up && (-least) * least < -1.9 && least * least > two;
}

int main(int count, char** words) {
    const bool evaluate_mode = count == 3 && !std::strcmp(words[1], "--evaluate");
    const bool limited = count == 4 && !std::strcmp(words[2], "--seconds");
    if (!(count == 2 || evaluate_mode || limited)) {
        std::cerr << "usage: undertow-checker FILE [--seconds T]\n";
        return 1;
    }
    try {
        if (!rounds_up()) refuse("this processor or compiler does not round upwards when told to");
        std::ifstream file(words[evaluate_mode ? 2 : 1], std::ios::binary);
        std::stringstream content;
        if (!file || !(content << file.rdbuf())) refuse("the file cannot be read");
        return evaluate_mode ? evaluate_all(content.str()) : check(content.str(), limited ? std::atof(words[3]) : 600.0);
    } catch (const std::exception& error) {
        std::fflush(stdout);
        std::cerr << "refused: " << error.what() << "\n";
        return 1;
    }
}
